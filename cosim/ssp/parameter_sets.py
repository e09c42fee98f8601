"""Parameter sets and their mappings to other names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from cosim.base.errors import InputError
from cosim.ssp.elements import Element
from cosim.ssp.notes import Notes
from cosim.ssp.structure import LinearTransformation, SspParameter
from cosim.storage.yaml_file import did_you_mean, format_value

SET = "application/x-ssp-parameter-set"
REALS = ("Real", "Float64", "Float32")
WHOLE = ("Integer", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
BOOLEANS = {"true": True, "1": True, "false": False, "0": False}
TYPES = (*REALS, *WHOLE, "Boolean", "String", "Enumeration", "Binary")


class ParameterReader(Notes):
    """Reader of parameter bindings."""

    def _parameters(self, element: Element) -> Iterator[SspParameter]:
        """Yield an element's bound parameters under mapped names."""
        for binding in element.all("ssd:ParameterBindings", "ssd:ParameterBinding"):
            if (kind := binding.get("type") or SET) != SET:
                self.note(binding, f"type {format_value(kind)} is not read here; {SET} is")
                continue
            holder = self._content(binding, "ssd:ParameterValues", "ssv:ParameterSet")
            if holder is None:
                continue
            prefix = binding.get("prefix") or ""
            values = [replace(p, name=prefix + p.name) for p in self._set(holder)]
            mapping = binding.first("ssd:ParameterMapping")
            yield from values if mapping is None else self._map_names(mapping, values)

    def _content(self, element: Element, *path: str) -> Element | None:
        """Return inline content, or the root of the referenced file; None after noting a fault."""
        source, tag = element.get("source"), path[-1]
        if source is None:
            if (inline := element.first(*path)) is None:
                self.note(element, f"it has neither a source nor {tag} in it; add one")
            return inline
        if (base := element.get("sourceBase") or "SSD") != "SSD":
            self.note(element, f"sourceBase {format_value(base)} is not read here; take the file out of the FMU")
            return None
        file = self.package.resolve(source)
        if isinstance(file, str):
            self.note(element, file)
            return None
        try:
            root = self.package.element(file)
        except InputError as error:
            self.faults += error.faults
            return None
        if root.tag != tag:
            self.note(root, f"it should be {tag}")
            return None
        self._version(root)
        return root

    def _set(self, holder: Element) -> Iterator[SspParameter]:
        units = self._units(holder, "ssv:Units")
        for element in holder.all("ssv:Parameters", "ssv:Parameter"):
            name = element.get("name")
            typed = next((c for c in element.children if c.tag.startswith("ssv:")), None)
            if not name or typed is None:
                self.note(element, "it has no value; add one such as ssv:Real" if name else "it has no name; add one")
            elif (value := self._value(typed)) is not None:
                yield SspParameter(name, value, typed.get("unit"), units, element)

    def _value(self, typed: Element) -> Any:
        """Return a typed value; None after noting a fault."""
        kind, text = typed.tag.partition(":")[2], typed.get("value")
        if text is None and (entries := list(typed.all("ssv:Item")) or list(typed.all("ssv:Value"))):
            self.note(typed, f"{len(entries)} values; arrays are not read here, bind their elements by name")
        elif kind not in TYPES:
            self.note(typed, f"is no type of a value{did_you_mean(kind, TYPES[:-1])}")
        elif text is None:
            self.note(typed, "it has no value; add it")
        elif kind in REALS:
            return self._number(typed, "value", None)
        elif kind in WHOLE:
            return self._whole_number(typed, text)
        elif kind != "Boolean":
            return text
        elif text not in BOOLEANS:
            self.note(typed, f"value {format_value(text)}: it is true or false")
        else:
            return BOOLEANS[text]
        return None

    def _whole_number(self, typed: Element, text: str) -> int | None:
        """Return an exact whole number; None after noting a fault."""
        value = self._number(typed, "value", None)
        if value is None:
            return None
        if value != int(value):
            self.note(typed, f"value {format_value(text)}: it is a whole number")
            return None
        return int(text) if text.strip().lstrip("+-").isdigit() else int(value)

    def _map_names(self, mapping: Element, values: list[SspParameter]) -> Iterator[SspParameter]:
        """Yield parameters renamed by a mapping, without unmapped ones."""
        holder = self._content(mapping, "ssm:ParameterMapping")
        by_name: dict[str, list[SspParameter]] = {}
        for value in values:
            by_name.setdefault(value.name, []).append(value)
        for entry in () if holder is None else holder.all("ssm:MappingEntry"):
            source, target = entry.get("source"), entry.get("target")
            if source == "" and target:  # a placeholder without source
                continue
            if not source or not target:
                self.note(entry, f"it has no {'target' if source else 'source'}; add it")
                continue
            if source not in by_name:
                self.warn(entry, f"the parameter set has no {format_value(source)}{did_you_mean(source, by_name)}")
            linear = self._linear(entry)
            for value in by_name.get(source, ()):
                if linear != LinearTransformation(exact=linear.exact) and isinstance(value.value, (bool, str)):
                    self.note(entry, f"a linear transformation of {format_value(value.value)}; it takes numbers")
                else:
                    yield replace(value, name=target, linear=linear)
