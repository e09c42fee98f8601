// The tree of all signals of all runs. Only the rows that are in sight are elements, however many signals there are.
/* global make */
/* exported SignalTree */

const ROW = 26; // height of a row [px]
const DOUBLE = 500; // between the clicks of a double-click, at most [ms]

// Names as a tree of their parts; a name may be a signal and a group at once.
function trieOf(names) {
  const root = { children: new Map() };
  for (const name of names) {
    let node = root;
    for (const part of name.split(".")) {
      if (!node.children.has(part)) node.children.set(part, { label: part, children: new Map() });
      node = node.children.get(part);
    }
    node.signal = name;
  }
  return root;
}
const signalsBelow = (node) => [
  ...(node.signal === undefined ? [] : [node.signal]),
  ...[...node.children.values()].flatMap(signalsBelow),
];

class SignalTree {
  // runs: [{label, names, units}]; add(curves, isNew): what Enter does, with [run, name] pairs
  constructor(box, runs, add) {
    Object.assign(this, { box, runs, add, group: "run", words: "", open: new Set(), rows: [], at: 0 });
    this.tries = new Map();
    this.inner = make("div", { role: "none", class: "tree-rows" });
    box.append(this.inner);
    box.addEventListener("scroll", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(box);
    box.addEventListener("keydown", (event) => this.key(event));
    box.addEventListener("click", (event) => this.click(event));
    box.addEventListener("dragstart", (event) => {
      const row = this.rows[event.target.closest("[data-at]")?.dataset.at];
      event.dataTransfer.setData("text/plain", JSON.stringify({ curves: row.curves() }));
      event.dataTransfer.effectAllowed = "copy";
    });
    if (runs.length === 1) this.open.add("0");
    this.fill();
  }

  search(words) {
    this.words = words;
    this.fill();
  }
  regroup(group) {
    this.group = group;
    this.fill();
  }

  trie(run) {
    if (!this.tries.has(run.names)) this.tries.set(run.names, trieOf(run.names));
    return this.tries.get(run.names);
  }

  // The rows that are unfolded, or those that match the words.
  fill() {
    const before = this.rows[this.at]?.id;
    this.rows = [];
    const found = this.words ? this.matches() : null;
    if (this.group === "run") this.runs.forEach((run, place) => this.fillRun(run, place, found));
    else this.fillSignals(found);
    this.at = Math.max(
      0,
      this.rows.findIndex((row) => row.id === before),
    );
    this.inner.style.height = `${ROW * this.rows.length}px`;
    this.draw();
  }

  // The test of a name: all words of the search, of which * stands for any text; words may be of the run, too.
  matches() {
    const words = this.words.toLowerCase().split(/\s+/).filter(Boolean);
    const tests = words.map((word) => {
      if (!word.includes("*")) return (name) => name.includes(word);
      const pattern = new RegExp(
        `^${word
          .split("*")
          .map((p) => p.replace(/[^\w]/g, "\\$&"))
          .join(".*")}$`,
      );
      return (name) => pattern.test(name);
    });
    return (name, run = "") => tests.every((test) => test(name.toLowerCase()) || test(run.toLowerCase()));
  }

  row(id, level, label, curves, { group = false, unit = "", count = 0, isText = false } = {}) {
    const isOpen = group && (this.open.has(id) || (this.words && !this.open.has(`-${id}`)));
    this.rows.push({ id, level, label, curves, group, unit, count, isText, isOpen });
    return isOpen;
  }

  fillRun(run, place, found) {
    const test = found && ((name) => found(name, run.label)),
      own = test ? run.names.filter(test) : run.names,
      count = own.length;
    if (found && !count) return;
    const every = () => own.map((name) => [place, name]);
    if (!this.row(`${place}`, 1, run.label, every, { group: true, count })) return;
    if (found)
      for (const name of own) this.row(`${place}.${name}`, 2, name, () => [[place, name]], this.about(run, name));
    else
      this.fillNode(
        this.trie(run),
        `${place}`,
        2,
        (name) => [[place, name]],
        (name) => this.about(run, name),
      );
  }

  about({ units, kinds }, name) {
    return { unit: units[name], isText: kinds[name] === "text" };
  }

  fillNode(node, id, level, curvesOf, aboutOf) {
    for (const child of node.children.values()) {
      const inner = `${id}.${child.label}`,
        group = child.children.size > 0,
        count = group ? signalsBelow(child).length : 0,
        about = child.signal === undefined ? {} : aboutOf(child.signal);
      const isOpen = this.row(inner, level, child.label, () => signalsBelow(child).flatMap(curvesOf), {
        ...about,
        group,
        count,
      });
      if (isOpen) {
        if (child.signal !== undefined)
          this.row(`${inner}=`, level + 1, "(itself)", () => curvesOf(child.signal), about);
        this.fillNode(child, inner, level + 1, curvesOf, aboutOf);
      }
    }
  }

  fillSignals(found) {
    const names = [...new Set(this.runs.flatMap((run) => run.names))];
    const [units, kinds] = ["units", "kinds"].map((part) => Object.assign({}, ...this.runs.map((run) => run[part])));
    const aboutOf = (name) => this.about({ units, kinds }, name);
    const isHere = (run, name) => name in run.units && (!found || found(name, run.label));
    const curvesOf = (name) => this.runs.flatMap((run, place) => (isHere(run, name) ? [[place, name]] : []));
    if (!found) {
      if (this.union?.length !== names.length) [this.union, this.unionTrie] = [names, trieOf(names)];
      this.fillNode(this.unionTrie, "s", 1, curvesOf, aboutOf);
      return;
    }
    for (const name of names.filter((each) => curvesOf(each).length))
      this.row(`s.${name}`, 1, name, () => curvesOf(name), aboutOf(name));
  }

  draw() {
    const first = Math.max(0, Math.floor(this.box.scrollTop / ROW) - 4),
      end = Math.min(this.rows.length, first + Math.ceil((this.box.clientHeight || 400) / ROW) + 9);
    this.inner.replaceChildren(
      ...this.rows.slice(first, end).map((row, k) => {
        const at = first + k,
          mark = make("span", { class: "twig", "aria-hidden": "true" }, row.group ? (row.isOpen ? "▾" : "▸") : ""),
          more = row.group ? String(row.count) : row.isText ? "text" : row.unit && `[${row.unit}]`;
        return make(
          "div",
          {
            role: "treeitem",
            id: `row-${at}`,
            class: at === this.at ? "now" : null,
            draggable: "true",
            style: `top:${at * ROW}px;padding-left:${row.level * 14 - 8}px`,
            title: row.isText ? `${row.label}: texts are not drawn, a plot shows them at the cursor` : row.label,
            "aria-level": row.level,
            "aria-expanded": row.group ? String(row.isOpen) : null,
            "aria-selected": String(at === this.at),
            "aria-setsize": this.rows.length,
            "aria-posinset": at + 1,
            "data-at": at,
          },
          mark,
          make("span", { class: "name" }, row.label),
          make("span", { class: "unit" }, more || ""),
        );
      }),
    );
    if (this.rows.length) this.box.setAttribute("aria-activedescendant", `row-${this.at}`);
    else this.box.removeAttribute("aria-activedescendant");
  }

  go(at) {
    this.at = Math.max(0, Math.min(this.rows.length - 1, at));
    const top = this.at * ROW;
    if (top < this.box.scrollTop) this.box.scrollTop = top;
    if (top + ROW > this.box.scrollTop + this.box.clientHeight) this.box.scrollTop = top + ROW - this.box.clientHeight;
    this.draw();
  }

  fold(row, isOpen) {
    const id = row.id;
    if (this.words) this.open[isOpen ? "delete" : "add"](`-${id}`);
    else this.open[isOpen ? "add" : "delete"](id);
    this.fill();
  }

  click(event) {
    const place = event.target.closest("[data-at]");
    if (!place) return;
    this.at = Number(place.dataset.at);
    const row = this.rows[this.at],
      // A click draws the rows anew, after which a browser tells no dblclick.
      again = this.clicked?.id === row.id && event.timeStamp - this.clicked.time < DOUBLE;
    this.clicked = again ? null : { id: row.id, time: event.timeStamp };
    if (again) this.add(row.curves(), event.shiftKey);
    else if (row.group) this.fold(row, !row.isOpen);
    else this.draw();
  }

  key(event) {
    const row = this.rows[this.at],
      page = Math.max(1, Math.floor(this.box.clientHeight / ROW) - 1);
    if (!row || event.altKey || event.ctrlKey || event.metaKey) return;
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -Infinity, End: Infinity };
    if (event.key in steps) this.go(this.at + steps[event.key]);
    else if (event.key === "ArrowRight" && row.group && !row.isOpen) this.fold(row, true);
    else if (event.key === "ArrowLeft" && row.group && row.isOpen) this.fold(row, false);
    else if (event.key === "ArrowLeft")
      this.go(this.rows.findLastIndex((other, k) => k < this.at && other.level < row.level));
    else if (event.key === "Enter") this.add(row.curves(), event.shiftKey);
    else return;
    event.preventDefault();
  }
}
