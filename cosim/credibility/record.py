"""The record of credibility in an FMU: content, schema, its files in the FMU, and the SHA-256 of the FMU."""

from __future__ import annotations

import base64
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from pydantic import BaseModel, ConfigDict

from cosim.core.drafts import draft_of
from cosim.core.errors import InputError
from cosim.core.extras import optional
from cosim.core.text import counted, join_names, plain
from cosim.core.version import __version__
from cosim.credibility.bands import Bands, Finite
from cosim.credibility.found import IDENTITY, RECORD, content_hash, identity_of, read_credibility
from cosim.credibility.region import Region
from cosim.files.archive import DAMAGES
from cosim.fmi.fmu_build import archive_member

SRMD = "extra/org.ssp-standard.ssp-traceability.srmd/resourceMetaData.srmd"  # place and name of the standard
SRMD_VERSION, LAYERED_STANDARD = "1.0.0", "1.0-rc.2"  # of the format, and the release of SSP LS Traceability
SRMD_NAMESPACES = {
    "srmd": "http://ssp-standard.org/SSPTraceability1/SimulationResourceMetaData",
    "stc": "http://ssp-standard.org/SSPTraceability1/SSPTraceabilityCommon",
    "xlink": "http://www.w3.org/1999/xlink",
}


class LogRecord(BaseModel):
    """A measured log.

    source: name of the file
    sha256: SHA-256 of the file
    time: date and time of the last change of the file
    duration: time from the first row to the last [s]
    step: usual time between rows [s]
    """

    source: str
    sha256: str
    time: str
    rows: int
    duration: Finite
    step: Finite


class ParameterRecord(BaseModel):
    """An estimated parameter.

    ci95: 95 % confidence interval; null if the logs do not determine the parameter alone
    """

    value: Finite
    unit: str
    ci95: tuple[Finite, Finite] | None


class Correlations(BaseModel):
    """Correlations of the estimates, in the order of the names."""

    names: list[str] = []
    matrix: list[list[Finite]] = []


class Credibility(BaseModel):
    """The region in which an FMU is valid, and the size of its errors there.

    command: command that estimated the FMU
    verdict: verdict of that command
    sentence: verdict in plain words
    logs: estimation logs, from which region and bands are computed
    sealed: logs that were opened after the estimation; region and bands do not use them
    parameters: estimated parameters by name
    versions: versions of the software
    """

    model_config = ConfigDict(title="credibility.json")

    schema_version: Literal[1] = 1
    command: Literal["cosim refine", "cosim fit"]
    model: str
    verdict: str
    sentence: str
    logs: list[LogRecord]
    sealed: list[LogRecord] = []
    parameters: dict[str, ParameterRecord] = {}
    correlations: Correlations = Correlations()
    region: Region
    bands: Bands
    versions: dict[str, str] = {"cosim": __version__}

    def lines(self) -> list[str]:
        """Return the record in about ten lines of text."""
        region, bands = self.region, self.bands
        logs = f"{counted(len(self.logs), 'log')}, {plain(sum(log.duration for log in self.logs))} s in all"
        sealed = f"; {counted(len(self.sealed), 'sealed log')}" if self.sealed else ""
        lines = [f"credibility: by {self.command} {self.versions.get('cosim', '')}, verdict {self.verdict}"]
        lines += [f"  {self.sentence}", f"  based on {logs}{sealed}"]
        values = [f"{name} = {_with_interval(p)}" for name, p in self.parameters.items()]
        lines += [f"  estimated: {join_names(values)}"] if values else []
        if region.reason:
            lines.append(f"  region: none, {region.reason}")
        else:
            moved = [c for c in region.coordinates if not c.is_constant]
            ranges = [f"{c.name} {plain(c.low, 3)} … {plain(c.high, 3)} {c.unit}".rstrip() for c in moved]
            lines.append(f"  region: {join_names(ranges)}")
            constant = region.constant
            lines += [f"  constant in the logs: {join_names(constant)}"] if constant else []
        if bands.reason:
            lines.append(f"  error bands: none, {bands.reason}")
        else:
            kind = "" if bands.held_out else ", from the logs of the estimate itself"
            lines.append(f"  error bands, {100 * bands.level:g} %{kind}:")
            for name, widths in bands.widths.items():
                known = [(h, w) for h, w in zip(bands.horizons, widths, strict=True) if w is not None]
                ends = [known[0], *(known[-1:] if len(known) > 1 else [])]
                unit = bands.units.get(name, "")
                lines.append(
                    f"    {name}: "
                    + ", ".join(f"±{plain(w, 2)} {unit}".rstrip() + f" up to {plain(h)} s" for h, w in ends)
                )
        return lines


def _with_interval(p: ParameterRecord) -> str:
    interval = f" ({plain(p.ci95[0], 4)} … {plain(p.ci95[1], 4)})" if p.ci95 else ""
    return f"{plain(p.value, 4)} {p.unit}".rstrip() + interval


# -- files of an FMU ---------------------------------------------------------------------------------------


def attach(fmu: Path, record: Credibility) -> None:
    """Write a record, metadata for SSP and the SHA-256 of the content into an FMU, replacing earlier ones."""
    content = record.model_dump(mode="json")
    members = {RECORD: json.dumps(content, allow_nan=False).encode(), SRMD: _srmd(record)}
    _rewrite(fmu, members, drop=IDENTITY)
    _rewrite(fmu, {IDENTITY: json.dumps({"sha256": content_hash(fmu)}).encode()})


def _rewrite(fmu: Path, members: Mapping[str, bytes], drop: str = "") -> None:
    """Write files into an FMU, after its other files, which keep their dates; replace files of the same name.

    Args:
        drop: File to leave out.
    """
    with draft_of(fmu) as draft, zipfile.ZipFile(fmu) as old, zipfile.ZipFile(draft, "w") as new:
        for member in old.infolist():
            if member.filename not in members and member.filename != drop:
                new.writestr(member, old.read(member), member.compress_type)
        for name, data in sorted(members.items()):
            new.writestr(archive_member(name), data)


def _srmd(record: Credibility) -> bytes:
    """Return the metadata of the FMU as a simulation resource (SRMD of SSP LS Traceability)."""
    for prefix, address in SRMD_NAMESPACES.items():
        ElementTree.register_namespace(prefix, address)
    srmd, stc, xlink = (f"{{{address}}}" for address in SRMD_NAMESPACES.values())
    about = {"version": SRMD_VERSION, "name": record.model, "generationTool": f"cosim {__version__}"}
    root = ElementTree.Element(f"{srmd}SimulationResourceMetaData", about)
    kind = {"type": "org.cosim.credibility", f"{xlink}type": "simple"}
    kind[f"{xlink}href"] = f"../{RECORD.removeprefix('extra/')}"
    group = ElementTree.SubElement(root, f"{stc}Classification", kind | {"linkedType": "application/json"})
    region = record.region.reason or ", ".join(
        f"{c.name} {c.low:.4g} .. {c.high:.4g} {c.unit}".rstrip() for c in record.region.coordinates
    )
    bands = record.bands.reason or f"{record.bands.level:g} of the errors, up to {record.bands.horizons[-1]:g} s"
    entries = {
        "standard": f"SSP LS Traceability {LAYERED_STANDARD}",
        "verdict": record.verdict,
        "statement": record.sentence,
        **{f"log {k}": f"{log.source} sha256 {log.sha256}" for k, log in enumerate(record.logs, 1)},
        **{f"parameter {n}": _with_interval(p) for n, p in record.parameters.items()},
        "region": region,
        "error bands": bands,
    }
    for keyword, text in entries.items():
        ElementTree.SubElement(group, f"{stc}ClassificationEntry", {"keyword": keyword}).text = text
    content: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return content


def require_credibility(fmu: Path) -> tuple[Credibility, str]:
    """Return the record of an FMU and its problem, else empty; raise InputError without a record."""
    record, problem = read_credibility(fmu)
    if record is None:
        cure = "`cosim refine` and `cosim fit` write one into the FMU that they deliver"
        raise InputError.at(fmu, problem or f"has no record of credibility; {cure}")
    return record, problem


# -- identity ------------------------------------------------------------------------------------------------


def sign(fmu: Path, key: Path) -> None:
    """Sign the content of an FMU.

    Args:
        key: File of an Ed25519 private key, PEM without a password.

    Raises:
        InputError: The key cannot be used, or cryptography is not installed.
    """
    sha = content_hash(fmu)
    signature = base64.b64encode(_key(key, "private").sign(bytes.fromhex(sha))).decode()
    _rewrite(fmu, {IDENTITY: json.dumps({"sha256": sha, "algorithm": "Ed25519", "signature": signature}).encode()})


def check_signature(fmu: Path, key: Path) -> None:
    """Check that the owner of a key has signed the content of an FMU.

    Args:
        key: File of an Ed25519 public key, PEM.

    Raises:
        InputError: The key cannot be used, or the FMU is not signed by it or was changed later.
    """
    public = _key(key, "public")
    try:
        identity, content = identity_of(fmu), content_hash(fmu)
    except DAMAGES as error:
        raise InputError.at(fmu, f"is damaged: {error}; get it from its author again") from None
    if not isinstance(identity.get("signature"), str):
        raise InputError.at(fmu, "is not signed; get the signed FMU from its author")
    try:
        public.verify(base64.b64decode(identity["signature"]), bytes.fromhex(content))
    except (ValueError, optional("cryptography.exceptions", str(key)).InvalidSignature):
        raise InputError.at(
            fmu, f"differs from what the owner of {key.name} signed; get it from its author again"
        ) from None


def _key(path: Path, kind: Literal["private", "public"]) -> Any:
    serialization, ed25519 = (
        optional(f"cryptography.hazmat.primitives.{name}", str(path))
        for name in ("serialization", "asymmetric.ed25519")
    )
    password = [None] if kind == "private" else []
    try:
        key = getattr(serialization, f"load_pem_{kind}_key")(path.read_bytes(), *password)
    except (OSError, ValueError, TypeError) as error:
        raise InputError.at(path, f"is not a {kind} key in PEM format without password: {error}") from None
    if not isinstance(key, getattr(ed25519, f"Ed25519{kind.title()}Key")):
        raise InputError.at(path, f"is not a {kind} key of Ed25519")
    return key
