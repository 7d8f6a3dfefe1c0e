"""Settings of a run: what a config file or the command line may say, checked once, frozen."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.errors import RefusedError
from beltrami_cli.extension import EXTENSIONS
from beltrami_cli.flows import FLOWS, PHI_LAWS, SCHEMES

LAWS = ("linear", "geometric")
DEFAULT_ITERATIONS = 20  # as in every example of the paper
MOST_ITERATIONS = 10_000_000  # a typing error: days of work even on the smallest surface
DEFAULT_BAND = 4.0  # half-width in voxels of the largest spacing: the local cubic's stencil is whole inside it
FWHM_TO_TIME = 1 / (16 * math.log(2))  # heat flow for t mm^2 is a Gaussian of FWHM sqrt(16 ln 2 t) mm


@dataclass(frozen=True)
class Beta:
    """beta over the iterations, mm per data unit: one value, equal stretches of several, or a run between two.

    values: empty where beta is to be chosen from the data ("auto"). law: None, "linear" or "geometric".
    """

    values: tuple[float, ...] = ()
    law: str | None = None

    @property
    def is_auto(self) -> bool:
        return not self.values

    def over(self, iterations: int) -> np.ndarray:
        """(K,) beta of each iteration."""
        if self.law is not None:
            start, stop = self.values
            return (np.linspace if self.law == "linear" else np.geomspace)(start, stop, iterations)
        stretch = np.arange(iterations) * len(self.values) // max(iterations, 1)
        return np.array(self.values)[stretch]

    def __str__(self) -> str:
        if self.is_auto:
            return "auto"
        text = (":" if self.law else ",").join(map(repr, self.values))
        return f"{text}:{self.law}" if self.law else text


def parse_beta(given: Any) -> Beta:
    """Beta from a number, "A:B[:law]", "B1,B2,...", "auto", a list or {start, stop, law}.

    Raises RefusedError for anything else, and for values that are negative or not finite.
    """
    if isinstance(given, Beta):
        return given
    values: tuple[float, ...]
    try:
        law = None
        if isinstance(given, Mapping):
            rest = dict(given)
            values, law = _numbers([rest.pop("start"), rest.pop("stop")]), str(rest.pop("law", "linear"))
            if rest:
                raise ValueError
        elif isinstance(given, str) and given.strip() == "auto":
            return Beta()
        elif isinstance(given, str) and ":" in given:
            first, last, *laws = given.split(":")
            values, law = (float(first), float(last)), (laws or ["linear"])[0]
            if len(laws) > 1:
                raise ValueError
        else:
            values = _numbers(given)
    except (ValueError, TypeError, KeyError):
        raise RefusedError(
            f"beta: found {given!r}; expected a number (mm per data unit), START:STOP[:linear|geometric], "
            "B1,B2,... or auto"
        ) from None
    if not values or not all(math.isfinite(v) and v >= 0 for v in values):
        raise RefusedError(f"beta: found {given!r}; expected finite values of 0 or more (mm per data unit)")
    if law not in (None, *LAWS):
        raise RefusedError(f"beta: found the law {law!r}; expected {' or '.join(LAWS)}")
    if law == "geometric" and min(values) == 0:
        raise RefusedError(f"beta: found {given!r}; a geometric run needs both ends above 0, or use linear")
    return Beta(values, law)


@dataclass(frozen=True)
class Settings:
    """How to denoise: everything but the files. Raises RefusedError where values or their combination make no sense.

    flow, phi, scheme: names in `flows`. beta: see `parse_beta`; eps: data units per mm, for l1 and tv (beta = 1/eps).
    dt: mm^2, None for 0.9 of the stability bound. iterations, time (mm^2), fwhm (mm): at most one of them.
    extension: a name in `extension`; extend_every: steps between re-extensions, 0 for never, None for the default.
    band: half-width in mm, None for 4 voxels of the largest spacing. inside: the sign of Psi inside.
    outside: what OUT holds beyond the band. precision: of computation and OUT. threads: None for all that it may use.
    flat: no surface, P = I (Eqs. 10-11).
    """

    flow: str = "beltrami"
    phi: str | None = None
    beta: Beta = field(default_factory=Beta)
    eps: float | None = None
    scheme: str = "symmetric"
    flat: bool = False
    dt: float | None = None
    iterations: int | None = None
    time: float | None = None
    fwhm: float | None = None
    extension: str = "closest-point"
    extend_every: int | None = None
    band: float | None = None
    inside: str = "negative"
    outside: str = "nan"
    precision: str = "float32"
    threads: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "beta", parse_beta(self.beta))
        for name, known in (
            ("flow", FLOWS),
            ("phi", (*PHI_LAWS, None)),
            ("scheme", tuple(SCHEMES)),
            ("extension", EXTENSIONS),
            ("inside", ("negative", "positive")),
            ("outside", ("nan", "zero", "keep")),
            ("precision", ("float32", "float64")),
        ):
            if getattr(self, name) not in known:
                names = ", ".join(str(k) for k in known if k is not None)
                raise RefusedError(f"{name}: found {getattr(self, name)!r}; expected one of {names}")
        for name, least in (("eps", None), ("dt", None), ("band", None), ("time", 0.0), ("fwhm", 0.0)):
            _require_number(name, getattr(self, name), least)
        for name, lowest in (("iterations", 0), ("extend_every", 0), ("threads", 1)):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, Integral) or value < lowest):
                raise RefusedError(f"{name}: found {value!r}; expected a whole number of {lowest} or more")
        self._require_sensible_combination()

    def _require_sensible_combination(self) -> None:
        durations = [n for n in ("iterations", "time", "fwhm") if getattr(self, n) is not None]
        if len(durations) > 1:
            raise RefusedError(f"{' and '.join(durations)} both say how long to run; give one of them")
        if self.phi is not None and self.flow != "phi":
            raise RefusedError(f"phi: belongs to the flow phi; found the flow {self.flow}; add --flow phi or drop it")
        if self.eps is not None and self.flow not in ("l1", "tv"):
            raise RefusedError(f"eps: belongs to the flows l1 and tv; found the flow {self.flow}, which takes beta")
        if not self.beta.is_auto and self.flow in ("l1", "tv"):
            raise RefusedError(f"beta: the flow {self.flow} has none; its edges are set by eps (beta = 1/eps)")
        if not self.beta.is_auto and self.flow == "l2":
            raise RefusedError("beta: the flow l2 keeps no edges and has none; drop it, or use --flow beltrami")
        if self.flat and (self.band is not None or self.extension != "closest-point" or self.extend_every):
            raise RefusedError("flat: without a surface there is no band and no extension; drop those options")

    @property
    def phi_name(self) -> str:
        return self.phi or "perona-malik"

    @property
    def reextends_every(self) -> int:
        """Steps between re-extensions: 5, but none where the data are to stay as they are off the surface."""
        if self.flat:
            return 0
        if self.extend_every is not None:
            return self.extend_every
        return 0 if self.extension == "none" else 5

    def half_width(self, spacing: np.ndarray) -> float:
        """Half-width of the band in mm on voxels of `spacing` (axes with more than one voxel); RefusedError if thin."""
        widest = float(spacing.max())
        if self.band is not None and self.band < 1.5 * widest:
            raise RefusedError(
                f"band: found a half-width of {self.band:g} mm; expected at least 1.5 voxels of the largest spacing "
                f"({1.5 * widest:g} mm) so that the surface's own voxels have neighbours in it"
            )
        return DEFAULT_BAND * widest if self.band is None else self.band

    def duration(self, dt: float) -> tuple[int, float, str]:
        """(iterations, dt in mm^2, what ends the run); a given time is met exactly, by a dt no larger than given."""
        if self.time is None and self.fwhm is None:
            iterations = DEFAULT_ITERATIONS if self.iterations is None else self.iterations
            _require_countable("iterations", iterations)
            return iterations, dt, "iterations"
        reason = "time" if self.fwhm is None else "fwhm"
        total = self.time if self.fwhm is None else self.fwhm * self.fwhm * FWHM_TO_TIME
        assert total is not None
        _require_countable(reason, total / dt)
        iterations = math.ceil(total / dt - 1e-9)  # rounding must not add a step
        return iterations, (total / iterations if iterations else dt), reason


def _require_number(name: str, value: Any, least: float | None) -> None:
    if value is None:
        return
    number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not number or (value < least if least is not None else value <= 0):
        wanted = "above 0" if least is None else f"of {least:g} or more"
        raise RefusedError(f"{name}: found {value!r}; expected a finite number {wanted}")


def _require_countable(name: str, iterations: float) -> None:
    if iterations > MOST_ITERATIONS:
        raise RefusedError(
            f"{name}: found {iterations:.4g} iterations; expected at most {MOST_ITERATIONS:.0e}: is it in mm^2 or mm?"
        )


@dataclass(frozen=True)
class Job:
    """One run: which files, and how. mesh: None for one beside the volume, () for none."""

    data: Path
    volume: Path
    levelset: Path | None = None
    mesh: tuple[Path, ...] | None = None
    spacing: tuple[float, ...] | None = None
    resample: bool = False
    overwrite: bool = False
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        if self.settings.flat and self.levelset is not None:
            raise RefusedError("flat: there is no surface, so LEVELSET is omitted: beltrami denoise --flat DATA -o OUT")
        if not self.settings.flat and self.levelset is None:
            raise RefusedError("LEVELSET is missing: give LEVELSET and DATA, or DATA alone with --flat")
        if self.settings.flat and self.mesh:
            raise RefusedError("flat: there is no surface, so there is no mesh to write; drop --mesh")
        if self.settings.flat and self.resample:
            raise RefusedError("flat: there is no level set's grid to resample onto; drop --resample")

    @property
    def inputs(self) -> list[Path]:
        return [path for path in (self.levelset, self.data) if path is not None]


# What a config file may say: section, key and the field of Job or Settings that it sets.
KEYS: dict[str, dict[str, str]] = {
    "input": {k: k for k in ("levelset", "data", "spacing", "resample", "inside")},
    "output": {k: k for k in ("volume", "mesh", "outside", "overwrite", "precision")},
    "flow": {"name": "flow", **{k: k for k in ("phi", "beta", "eps", "scheme", "dt", "flat")}},
    "time": {k: k for k in ("iterations", "time", "fwhm")},
    "band": {"half_width": "band", **{k: k for k in ("extension", "extend_every")}},
    "run": {"threads": "threads"},
}


def read_config(path: Path) -> dict[str, Any]:
    """The fields that a TOML file sets, paths made relative to the file.

    Raises RefusedError where the file is missing, is not TOML, or has an unknown section or key.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RefusedError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RefusedError(f"{path}: not a valid TOML file ({error}); correct it") from error
    given: dict[str, Any] = {}
    for section, table in tables.items():
        if section == "for_each":
            raise RefusedError(f"{path}: has [for_each], which makes many runs; expected a config of one run")
        if section not in KEYS:
            raise RefusedError(f"{path}: unknown section [{section}]{_nearest(section, KEYS)}")
        if not isinstance(table, dict):
            raise RefusedError(f"{path}: found {section!r} as a key or a list; expected a section [{section}]")
        for key, value in table.items():
            if key not in KEYS[section]:
                raise RefusedError(f"{path}: unknown key {key!r} in [{section}]{_nearest(key, KEYS[section])}")
            given[KEYS[section][key]] = _from_toml(path, section, key, value)
    return given


def make_job(given: Mapping[str, Any]) -> Job:
    """A checked Job from fields by name; DATA and OUT must be among them."""
    for name, what in (("data", "DATA"), ("volume", "OUT (-o FILE)")):
        if given.get(name) is None:
            raise RefusedError(f"{what} is missing: beltrami denoise LEVELSET DATA -o OUT")
    names = {f.name for f in fields(Settings)}
    settings = Settings(**{k: v for k, v in given.items() if k in names})
    return Job(**{k: v for k, v in given.items() if k not in names}, settings=settings)


def overlaid(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of `over` in place of those of `base`; what they displace goes with them.

    One way to say how long to run displaces the others, another flow the old one's parameters, flat all of the surface.
    """
    durations = {"iterations", "time", "fwhm"}
    displaced = durations if durations & over.keys() else set()
    if "flow" in over:
        takes = {"l2": set(), "l1": {"eps"}, "tv": {"eps"}, "phi": {"phi", "beta"}}.get(over["flow"], {"beta"})
        displaced = displaced | ({"phi", "beta", "eps"} - takes)
    if over.get("flat"):
        displaced = displaced | {"levelset", "mesh", "resample", "band", "extension", "extend_every"}
    return {**{k: v for k, v in base.items() if k not in displaced}, **over}


def parse_spacing(given: Any) -> tuple[float, ...]:
    """Millimetres from "S", "SX,SY,SZ", a number or a list; raises RefusedError for anything else."""
    try:
        values = _numbers(given)
    except (TypeError, ValueError):
        values = ()
    if len(values) not in (1, 2, 3) or not all(math.isfinite(v) and v > 0 for v in values):
        raise RefusedError(f"spacing: found {given!r}; expected one number above 0 (mm), or one per axis: SX,SY,SZ")
    return values


def _numbers(given: Any) -> tuple[float, ...]:
    """Numbers from "A,B,...", a list or one number; raises TypeError or ValueError for anything else."""
    parts = given.split(",") if isinstance(given, str) else given if isinstance(given, list | tuple) else [given]
    if any(isinstance(part, bool) for part in parts):
        raise TypeError("a truth value is no number")
    return tuple(float(part) for part in parts)


def _from_toml(path: Path, section: str, key: str, value: Any) -> Any:
    """A TOML value as its field holds it."""
    where = f"{path}: [{section}] {key}"
    if key in ("resample", "overwrite", "flat"):
        if not isinstance(value, bool):
            raise RefusedError(f"{where}: found {value!r}; expected true or false")
        return value
    if key == "mesh":
        if value is False:
            return ()
        names = value if isinstance(value, list) else [value]
        return tuple(_path(path, where, name) for name in names)
    if key in ("levelset", "data", "volume"):
        return _path(path, where, value)
    if key == "spacing":
        return parse_spacing(value)
    if key == "beta":
        return parse_beta(value)
    if key == "dt" and value == "auto":
        return None
    return value


def _path(config: Path, where: str, value: Any) -> Path:
    if not isinstance(value, str) or not value:
        raise RefusedError(f"{where}: found {value!r}; expected the name of a file")
    return config.parent / value


def _nearest(name: str, known: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; expected one of {', '.join(known)}"
