// Pictures and files that a page saves.
/* exported escapeText, tag, pen, save, savePng, safeName */

const escapeText = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
function tag(name, attributes, inner = "") {
  const pairs = Object.entries(attributes).map(([key, value]) => ` ${key}="${escapeText(String(value))}"`);
  return `<${name}${pairs.join("")}>${inner}</${name}>`;
}

// The look of a line as attributes of its own, for a picture without a style sheet.
function pen(line) {
  const look = getComputedStyle(line);
  const names = ["stroke", "stroke-width", "stroke-dasharray", "stroke-linecap", "opacity"];
  return Object.fromEntries(names.map((name) => [name, look.getPropertyValue(name).replaceAll("px", "")]));
}

function save(content, name) {
  const address = URL.createObjectURL(content),
    link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

function savePng(svg, name) {
  const image = new Image();
  image.onload = () => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [2 * image.width, 2 * image.height];
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    canvas.toBlob((content) => save(content, name));
  };
  image.src = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(svg);
}

const safeName = (text) =>
  text
    .replace(/\u00b0/g, "deg")
    .replace(/%/g, "percent")
    .replace(/[^\p{L}\p{N}\p{M}.-]+/gu, "_")
    .slice(0, 80);
