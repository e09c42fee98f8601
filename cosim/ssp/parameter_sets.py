"""Parameter sets and their mappings to other names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from cosim.base.errors import InputError
from cosim.ssp.elements import Element
from cosim.ssp.notes import Notes
from cosim.ssp.structure import Linear, Parameter
from cosim.storage.yaml_file import did_you_mean, shown

SET = "application/x-ssp-parameter-set"
REALS = ("Real", "Float64", "Float32")
WHOLE = ("Integer", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
TRUTH = {"true": True, "1": True, "false": False, "0": False}


class ParameterReader(Notes):
    """Reader of parameter bindings."""

    def _parameters(self, element: Element) -> Iterator[Parameter]:
        """Yield an element's bound parameters under mapped names."""
        listed = element.first("ssd:ParameterBindings")
        for binding in () if listed is None else listed.all("ssd:ParameterBinding"):
            if (kind := binding.get("type") or SET) != SET:
                self.note(binding, f"type {shown(kind)} is not read here; {SET} is")
                continue
            holder = self._referred(
                binding, binding.first("ssd:ParameterValues", "ssv:ParameterSet"), "ssv:ParameterSet"
            )
            if holder is None:
                continue
            prefix = binding.get("prefix") or ""
            values = [replace(p, name=prefix + p.name) for p in self._set(holder)]
            mapping = binding.first("ssd:ParameterMapping")
            yield from values if mapping is None else self._mapped(mapping, values)

    def _referred(self, element: Element, inline: Element | None, tag: str) -> Element | None:
        """Return inline content, or the root of the referenced file."""
        source = element.get("source")
        if source is None:
            if inline is None:
                self.note(element, f"it has neither a source nor {tag} in it; add one")
            return inline
        if (base := element.get("sourceBase") or "SSD") != "SSD":
            self.note(element, f"sourceBase {shown(base)} is not read here; take the file out of the FMU")
            return None
        path = self.package.resolve(source)
        if isinstance(path, str):
            self.note(element, path)
            return None
        try:
            root = self.package.element(path)
        except InputError as error:
            self.faults += error.faults
            return None
        if root.tag != tag:
            self.note(root, f"it should be {tag}")
            return None
        self._version(root)
        return root

    def _set(self, holder: Element) -> Iterator[Parameter]:
        units = self._units(holder.first("ssv:Units"))
        listed = holder.first("ssv:Parameters")
        for each in () if listed is None else listed.all("ssv:Parameter"):
            name = each.get("name")
            typed = next((c for c in each.children if c.tag.startswith("ssv:")), None)
            if not name or typed is None:
                self.note(each, "it has no name; add one" if not name else "it has no value; add one such as ssv:Real")
                continue
            value = self._value(typed)
            if value is not None:
                yield Parameter(name, value, typed.get("unit"), units, each)

    def _value(self, typed: Element) -> Any:
        """Return a typed value; None after noting a fault."""
        kind, text = typed.tag.partition(":")[2], typed.get("value")
        if text is None and (entries := list(typed.all("ssv:Item")) or list(typed.all("ssv:Value"))):
            self.note(typed, f"{len(entries)} values; arrays are not read here, bind their elements by name")
            return None
        if kind in REALS:
            return self._number(typed, "value", None, needed=True)
        if kind in WHOLE:
            return self._whole_number(typed)
        if kind == "Boolean":
            if text not in TRUTH:
                self.note(typed, f"value {shown(text)}: it is true or false")
            return TRUTH.get(text or "")
        if kind not in {"String", "Enumeration", "Binary"}:
            hint = did_you_mean(kind, (*REALS, *WHOLE, "Boolean", "String", "Enumeration"))
            self.note(typed, f"is no type of a value{hint}")
            return None
        if text is None:
            self.note(typed, "it has no value; add it")
        return text

    def _whole_number(self, typed: Element) -> int | None:
        """Return an exact whole number; None after noting a fault."""
        value, text = self._number(typed, "value", None, needed=True), typed.get("value") or ""
        if value is None:
            return None
        if value != int(value):
            self.note(typed, f"value {shown(text)}: it is a whole number")
            return None
        return int(text) if text.strip().lstrip("+-").isdigit() else int(value)

    def _mapped(self, mapping: Element, values: list[Parameter]) -> Iterator[Parameter]:
        """Yield parameters renamed by a mapping, without unmapped ones."""
        holder = self._referred(mapping, mapping.first("ssm:ParameterMapping"), "ssm:ParameterMapping")
        if holder is None:
            return
        known: dict[str, list[Parameter]] = {}
        for value in values:
            known.setdefault(value.name, []).append(value)
        for entry in holder.all("ssm:MappingEntry"):
            source, target = entry.get("source"), entry.get("target")
            if source == "" and target:  # a placeholder without source
                continue
            if not source or not target:
                self.note(entry, f"it has no {'target' if source else 'source'}; add it")
                continue
            if source not in known:
                hint = did_you_mean(source, known)
                self.warn(entry, f"the parameter set has no {shown(source)}{hint}")
            linear = self._linear(entry, entry.get("suppressUnitConversion") in {"true", "1"})
            for value in known.get(source, ()):
                if linear != Linear(exact=linear.exact) and isinstance(value.value, (bool, str)):
                    self.note(entry, f"a linear transformation of {shown(value.value)}; it takes numbers")
                    continue
                yield replace(value, name=target, linear=linear)
