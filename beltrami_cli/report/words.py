"""The record of a run in words and tables, as the sheet and the page tell it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from beltrami_cli.report.style import unit

NONE = "–"
NOTHING = "The flow changed nothing."
EXTENSION_ALONE = "The flow changed nothing: what was removed is the extension to the surface alone."
# Told on their own, or drawn.
_APART = ("Parameters", "Sources", "Outputs", "Warnings", "Seconds", "Choice", "PerIteration", "GeneratedBy", "Request")


@dataclass(frozen=True)
class Table:
    """A table of text. heading: what it is of. columns: none for pairs of a name and a value."""

    heading: str
    rows: Sequence[Sequence[str]]
    columns: Sequence[str] = ()


def facts(record: Mapping[str, Any], period: float | None = None) -> list[tuple[str, str]]:
    """What a run did, in pairs of a name and a value; what the record lacks is left out. period: of angles."""
    noise, removed, smoothness, used = (
        record.get(key) or {} for key in ("Noise", "Removed", "Smoothness", "Parameters")
    )
    flow = " ".join(str(used[key]) for key in ("flow", "phi") if used.get(key) is not None)
    of = unit(period)
    where = "vertices" if "vertices" in removed else "voxels"
    beta = chosen_beta(record) or used.get("beta")
    seconds = [
        spent for phase, spent in (record.get("Seconds") or {}).items() if phase != "report" and spent is not None
    ]
    found = {
        "Noise": _change(_together(noise.get("sd"), of), _together(noise.get("after"), of)),
        f"Removed (rms, {where})": _figure(removed.get("rms"), of),
        "Smoothness (FWHM)": _change(_figure(smoothness.get("before_mm")), _figure(smoothness.get("after_mm"), " mm")),
        "Iterations": _figure(record.get("Iterations")),
        "Stopped by": str(record.get("StopReason") or ""),
        "Flow": flow + (f", beta {_figure(beta)}" if beta is not None else ""),
        "Denoised in": f"{sum(seconds):,.1f} s" if seconds else "",
    }
    return [(name, value) for name, value in found.items() if value]


def chosen_beta(record: Mapping[str, Any]) -> float | None:
    """What "auto" came to; None where beta was given, or where nothing was found."""
    asked, choice = record.get("Parameters") or {}, record.get("Choice") or {}
    return choice.get("beta") if str(asked.get("beta")).startswith("auto") else None


def _change(before: str, after: str) -> str:
    return f"{before or '?'} → {after or '?'}" if before or after else ""


def _together(per_channel: Sequence[float | None] | None, of: str) -> str:
    """The root of the mean square of the known ones."""
    known = [sd for sd in per_channel or () if sd is not None]
    return _figure(math.sqrt(sum(sd * sd for sd in known) / len(known)), of) if known else ""


def _figure(value: Any, of: str = "") -> str:
    """A number to three digits, whole ones in full; other things as they are; nothing for None."""
    if value is None:
        return ""
    return (f"{value:.3g}" if isinstance(value, float) and abs(value) < 1e5 else str(value)) + of


def tables(record: Mapping[str, Any]) -> Iterator[Table]:
    """Everything that the record says, but what goes on for as long as the iterations."""
    if record.get("Parameters"):
        beta = chosen_beta(record)
        used = record["Parameters"] if beta is None else {**record["Parameters"], "beta": f"{_text(beta)} (auto)"}
        yield Table("Parameters", _pairs(used))
    choice = record.get("Choice") or {}
    if choice.get("table"):
        columns = list(dict.fromkeys(key for row in choice["table"] for key in row))
        rows = [[_text(row.get(key)) for key in columns] for row in choice["table"]]
        yield Table("Automatic choice: what was tried", rows, [_spelt(key) for key in columns])
    chosen = {key: value for key, value in choice.items() if key not in ("table", "errors")}
    if chosen:
        yield Table("Automatic choice", _pairs(chosen))
    if record.get("Sources"):
        rows = [[_text(source.get(key)) for key in ("Role", "Path", "SHA256")] for source in record["Sources"]]
        yield Table("Sources", rows, ["Role", "Path", "SHA-256"])
    if record.get("Outputs"):
        yield Table("Outputs", [[_text(file)] for file in record["Outputs"]], ["Path"])
    if record.get("Seconds"):
        yield Table("Seconds", _pairs(record["Seconds"]))
    rest = {key: value for key, value in record.items() if key not in _APART}
    if rest:
        yield Table("Further figures", _pairs(rest))


def _pairs(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Pairs of a name and a value; the names of those without a value in one line, the last."""
    found = list(_flat(record))
    unset = ", ".join(name for name, value in found if value == NONE)
    return [(name, value) for name, value in found if value != NONE] + ([("not set", unset)] if unset else [])


def _flat(record: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Pairs of a name and a value, those of records within it too."""
    for field, value in record.items():
        name = f"{above}: {_spelt(field)}" if above else _spelt(field)
        if isinstance(value, Mapping):
            yield from _flat(value, name)
        else:
            yield name, _text(value)


def _spelt(key: object) -> str:
    return str(key).replace("_", " ")


def _text(value: Any) -> str:
    """A value as a reader expects it, numbers to six digits."""
    if value is None:
        return NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(f"({_text(each)})" if isinstance(each, (list, tuple)) else _text(each) for each in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{_spelt(key)} {_text(each)}" for key, each in value.items())
    return str(value)


def version(record: Mapping[str, Any]) -> str:
    """Which programs made it, and when, as the record says."""
    by = [f"{each.get('Name', '?')} {each.get('Version', '')}".strip() for each in record.get("GeneratedBy") or ()]
    return ", ".join([*by, *([str(record["Created"])] if record.get("Created") else [])])
