"""Settings of a run: what a config file or the command line may say, checked once, frozen."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from decimal import Decimal
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.errors import RefusedError
from beltrami_cli.extension import EXTENSIONS
from beltrami_cli.flows import FLOWS, PHI_LAWS, SCHEMES
from beltrami_cli.kinds import KINDS

LAWS = ("linear", "geometric")
FRAMES = ("scanner", "tkr")  # of a surface's coordinates
STOPS = ("auto", "discrepancy", "decorrelation")
DEFAULT_ITERATIONS = 20  # as in every example of the paper
MOST_ITERATIONS = 10_000_000  # a typing error: days of work even on the smallest surface
THINNEST_BAND = 1.5  # half-width in voxels of the largest spacing: a voxel at the surface, and its neighbours
MOST_DEPTH = 50  # voxels: more than any cortex, and minutes of sampling
DEFAULT_BAND = 4.0  # half-width in voxels of the largest spacing: the local cubic's stencil is whole inside it
MOST_STEPS = 1000  # where the data end the run: at the default dt a Gaussian of about 40 voxels FWHM, 50 on a curve
FWHM_TO_TIME = 1 / (16 * math.log(2))  # heat flow for t mm^2 is a Gaussian of FWHM sqrt(16 ln 2 t) mm
_MEMORY = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*([KMGT]?)(I?)B?\s*", re.ASCII | re.IGNORECASE)


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


def parse_period(given: Any) -> float:
    """The period of circular data, in their own unit, from a number, "360", "pi" or "2pi".

    Raises RefusedError for anything else, and for a period that is not finite and above 0.
    """
    try:
        if isinstance(given, str) and given.strip().endswith("pi"):
            period = float(given.strip().removesuffix("pi").strip() or 1) * math.pi
        else:
            (period,) = _numbers(given)
    except (TypeError, ValueError):
        period = math.nan
    if not (math.isfinite(period) and period > 0):
        raise RefusedError(f"period: found {given!r}; expected a number above 0 in the unit of DATA: 360, 24, 2pi ...")
    return period


def parse_depth(given: Any) -> tuple[float, float]:
    """(A, B) in mm along the normal, A <= B, from "A:B" or a list of two; raises RefusedError for anything else."""
    parts = given.tolist() if isinstance(given, np.ndarray) else given
    try:
        first, last = _numbers(parts.split(":") if isinstance(parts, str) else parts)
    except (TypeError, ValueError):
        first = last = math.nan
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise RefusedError(
            f"depth: found {given!r}; expected A:B in mm along the normal, A no larger than B, as in -2:2"
        )
    return first, last


def parse_memory(given: Any) -> int:
    """Bytes from "8G", "8GB", "500M" (powers of 1000), "8GiB" (powers of 1024) or a number of bytes.

    Raises RefusedError for anything else, and for less than one byte.
    """
    match = _MEMORY.fullmatch(given) if isinstance(given, str) else None
    size = 0
    if isinstance(given, Integral) and not isinstance(given, bool):
        size = int(given)
    elif match and (match[2] or not match[3]):
        size = int(Decimal(match[1]) * (1024 if match[3] else 1000) ** " KMGT".index(match[2].upper() or " "))
    if size < 1:
        raise RefusedError(f"memory: found {given!r}; expected an amount above 0: 8G, 500M, 2GiB, or a number of bytes")
    return size


@dataclass(frozen=True)
class Settings:
    """How to denoise: everything but the files. Raises RefusedError where values or their combination make no sense.

    flow: a name in `flows`, or "auto" to choose with the data; phi, scheme: names in `flows`. beta: see `parse_beta`;
    edge: the slope (data units per mm) that counts as one, beta = 1/edge; eps: data units per mm, for l1 and tv
    (beta = 1/eps). fidelity: L of the term L w (U0 - U), 1/mm^2.
    dt: mm^2, None for 0.9 of the stability bound. iterations, time (mm^2), fwhm (mm), stop: at most one of them.
    stop: a name in STOPS, the rule by which the data end the run; noise_sigma: standard deviation of the noise in data
    units, for "discrepancy", None for an estimate. seed: of all that is drawn.
    kind: a name in `kinds`; period: of circular data, in their unit, see `parse_period`; independent: a vector's
    channels run apart. missing: a data value that means none (NaN always does). fill: how far along the surface from
    valid data values are filled in, mm, None for all of a bank that holds any.
    extension: a name in `extension`; extend_every: steps between re-extensions, 0 for never, None for the default.
    depth: (A, B) mm along the normal over which data are averaged before the flow, see `parse_depth`.
    band: half-width in mm, None for 4 voxels of the largest spacing, or more if depth asks for it. inside: the sign of
    Psi inside. outside: what OUT holds beyond the band. precision: of computation and OUT. threads: None for all that
    it may use. flat: no surface, P = I (Eqs. 10-11).
    """

    flow: str = "beltrami"
    phi: str | None = None
    beta: Beta = field(default_factory=Beta)
    edge: float | None = None
    eps: float | None = None
    scheme: str = "symmetric"
    flat: bool = False
    fidelity: float | None = None
    dt: float | None = None
    iterations: int | None = None
    time: float | None = None
    fwhm: float | None = None
    stop: str | None = None
    noise_sigma: float | None = None
    seed: int = 0
    kind: str = "scalar"
    period: float | None = None
    independent: bool = False
    missing: float | None = None
    fill: float | None = None
    extension: str = "closest-point"
    extend_every: int | None = None
    depth: tuple[float, float] | None = None
    band: float | None = None
    inside: str = "negative"
    outside: str = "nan"
    precision: str = "float32"
    threads: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "beta", parse_beta(self.beta))
        if self.period is not None:
            object.__setattr__(self, "period", parse_period(self.period))
        if self.depth is not None:
            object.__setattr__(self, "depth", parse_depth(self.depth))
        self._require_known_names()
        self._require_numbers()
        if self.missing is not None and math.isnan(self.missing):
            object.__setattr__(self, "missing", None)
        self._require_sensible_flow()
        self._require_sensible_duration()
        self._require_sensible_values()
        self._require_sensible_surface()
        if self.edge is not None:
            object.__setattr__(self, "beta", parse_beta(1 / self.edge))

    def _require_known_names(self) -> None:
        for name, known in (
            ("flow", (*FLOWS, "auto")),
            ("phi", (*PHI_LAWS, None)),
            ("scheme", tuple(SCHEMES)),
            ("stop", (*STOPS, None)),
            ("kind", KINDS),
            ("extension", EXTENSIONS),
            ("inside", ("negative", "positive")),
            ("outside", ("nan", "zero", "keep")),
            ("precision", ("float32", "float64")),
        ):
            if getattr(self, name) not in known:
                names = ", ".join(str(k) for k in known if k is not None)
                raise RefusedError(f"{name}: found {getattr(self, name)!r}; expected one of {names}")
        if not isinstance(self.independent, bool):
            raise RefusedError(f"independent: found {self.independent!r}; expected true or false")

    def _require_numbers(self) -> None:
        for name in ("edge", "eps", "dt", "band", "noise_sigma"):
            _require_number(name, getattr(self, name), None)
        if self.eps is not None and math.isinf(1 / self.eps):
            raise RefusedError(f"eps: found {self.eps!r}, whose inverse is infinite; give a larger one")
        for name in ("time", "fwhm", "fill", "fidelity"):
            _require_number(name, getattr(self, name), 0.0)
        for name, lowest in (("iterations", 0), ("extend_every", 0), ("threads", 1)):
            if getattr(self, name) is not None:
                _require_whole(name, getattr(self, name), lowest)
        _require_whole("seed", self.seed, 0)
        if self.missing is not None and (not _is_real(self.missing) or math.isinf(self.missing)):
            raise RefusedError(f"missing: found {self.missing!r}; expected the number that means no value, as -1 or 0")

    def _require_sensible_flow(self) -> None:
        if self.edge is not None and not self.beta.is_auto and self.beta != Beta((1 / self.edge,)):
            raise RefusedError("beta and edge both say what counts as an edge (beta = 1/edge); give one of them")
        named = [name for name in ("phi", "edge", "eps") if getattr(self, name) is not None]
        named += [] if self.beta.is_auto else ["beta"]
        if self.flow == "auto" and named:
            raise RefusedError(f"{named[0]}: the flow auto chooses it with the data; drop it, or name the flow")
        if self.phi is not None and self.flow != "phi":
            raise RefusedError(f"phi: belongs to the flow phi; found the flow {self.flow}; add --flow phi or drop it")
        if self.eps is not None and self.flow not in ("l1", "tv"):
            raise RefusedError(f"eps: belongs to the flows l1 and tv; found the flow {self.flow}, which takes beta")
        edges = "beta" if self.edge is None else "edge"
        if edges in named and self.flow in ("l1", "tv"):
            raise RefusedError(f"{edges}: the flow {self.flow} has none; its edges are set by eps (beta = 1/eps)")
        if edges in named and self.flow == "l2":
            raise RefusedError(f"{edges}: the flow l2 keeps no edges and has none; drop it, or use --flow beltrami")

    def _require_sensible_duration(self) -> None:
        durations = [n for n in ("iterations", "time", "fwhm", "stop") if getattr(self, n) is not None]
        if len(durations) > 1:
            raise RefusedError(f"{' and '.join(durations)} both say how long to run; give one of them")
        if self.noise_sigma is not None and self.stop != "discrepancy":
            raise RefusedError(
                f"noise_sigma: belongs to the stop discrepancy; found the stop {self.stop or 'none'}; "
                "add --stop discrepancy or drop it"
            )
        if self.stop is not None and len(self.beta.values) > 1:
            raise RefusedError(
                f"beta: found {self.beta} with the stop {self.stop}; a schedule runs over a known number of "
                "iterations: give one beta, or --iterations in place of --stop"
            )
        if self.stop == "discrepancy" and self.flow == "auto":
            raise RefusedError(
                "stop: discrepancy compares input and output, and cannot tell which flow is best; found the flow auto; "
                "name the flow, or use --stop auto"
            )
        if self.stop == "decorrelation" and self.flow not in ("l2", "tv", "phi"):
            raise RefusedError(
                f"stop: decorrelation is for flows that keep the mean, l2, tv and phi; found the flow {self.flow}; "
                "use --stop auto or discrepancy"
            )
        if self.stop == "decorrelation" and self.fidelity:
            raise RefusedError(
                "stop: decorrelation is for flows that keep the mean, which fidelity does not; "
                "drop --fidelity, or use --stop auto or discrepancy"
            )

    def _require_sensible_values(self) -> None:
        if self.kind == "circular" and self.period is None:
            raise RefusedError("period: missing for the kind circular; give the value of a whole turn, as --period 360")
        if self.kind != "circular" and self.period is not None:
            raise RefusedError(
                f"period: belongs to the kind circular; found the kind {self.kind}; add --kind circular or drop it"
            )
        if self.independent and self.kind != "vector":
            raise RefusedError(
                f"independent: belongs to the kind vector; found the kind {self.kind}; add --kind vector or drop it"
            )

    def _require_sensible_surface(self) -> None:
        if self.flat and self.depth is not None:
            raise RefusedError("depth: runs along the normal of a surface; found flat, which has none; drop it")
        if self.flat and (self.band is not None or self.extension != "closest-point" or self.extend_every):
            raise RefusedError("flat: without a surface there is no band and no extension; drop those options")
        if self.depth is not None and self.extension != "closest-point":
            raise RefusedError(
                f"depth: belongs to the extension closest-point; found {self.extension}; drop one of the two"
            )

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
        """Half-width of the band in mm on voxels of `spacing` (axes with more than one voxel).

        Raises RefusedError where the one given is too thin for the voxels or the depth.
        """
        widest = float(spacing.max())
        reach = 0.0 if self.depth is None else max(map(abs, self.depth))
        if reach > MOST_DEPTH * widest:
            raise RefusedError(
                f"depth: found {self.depth} on voxels of {widest:g} mm; expected at most {MOST_DEPTH} voxels to either "
                "side: is it in mm?"
            )
        if self.band is None:
            return max(DEFAULT_BAND * widest, reach + THINNEST_BAND * widest)
        if self.band < THINNEST_BAND * widest:
            raise RefusedError(
                f"band: found a half-width of {self.band:g} mm; expected at least {THINNEST_BAND} voxels of the "
                f"largest spacing ({THINNEST_BAND * widest:g} mm) so that the surface's voxels have neighbours in it"
            )
        if self.depth is not None and self.band < reach:
            raise RefusedError(
                f"band: found a half-width of {self.band:g} mm; expected at least {reach:g} mm to hold the depth "
                f"{self.depth[0]:g}:{self.depth[1]:g}; widen it, or drop it for a band that does"
            )
        return self.band

    def duration(self, dt: float) -> tuple[int, float, str]:
        """(iterations, dt in mm^2, what ends the run); a given time is met exactly, by a dt no larger than given.

        Where the data end the run, the iterations are the most that it may take.
        """
        if self.stop is not None:
            return MOST_STEPS, dt, "iterations" if self.stop == "discrepancy" else self.stop
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
    if not _is_real(value) or not math.isfinite(value) or (value < least if least is not None else value <= 0):
        wanted = "above 0" if least is None else f"of {least:g} or more"
        raise RefusedError(f"{name}: found {value!r}; expected a finite number {wanted}")


def _require_whole(name: str, value: Any, lowest: int) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < lowest:
        raise RefusedError(f"{name}: found {value!r}; expected a whole number of {lowest} or more")


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _require_countable(name: str, iterations: float) -> None:
    if iterations > MOST_ITERATIONS:
        raise RefusedError(
            f"{name}: found {iterations:.4g} iterations; expected at most {MOST_ITERATIONS:.0e}: is it in mm^2 or mm?"
        )


@dataclass(frozen=True)
class Job:
    """One run: which files, and how. mesh: None for one beside the volume, () for none.

    levelset: a level-set volume, a segmentation (of which `labels` are inside, or whose surface runs `between` two) or
    a surface, whose coordinates are those of `frame` ("scanner", "tkr", None for what the file says).
    data: a volume, or, on a surface, values at its vertices; map: which of several maps, by name or number from 1.
    weights: how much each voxel or vertex counts (>= 0); mask: which count at all (not 0). filled: where the mask of
    what the run filled in is written. on: surfaces, and where values at their vertices are written. structure: in
    GIFTI's names, of what is written. spacing: mm, of .npy inputs; for values at vertices, of the band's voxels.
    report: where a picture of the run is written, .html or .png.
    memory: bytes that the run may need, None for any amount, see `parse_memory`; it changes no result.
    """

    data: Path
    volume: Path
    levelset: Path | None = None
    mesh: tuple[Path, ...] | None = None
    weights: Path | None = None
    mask: Path | None = None
    filled: Path | None = None
    report: Path | None = None
    on: tuple[tuple[Path, Path], ...] = ()
    labels: str | None = None
    between: str | None = None
    map: str | None = None
    frame: str | None = None
    structure: str | None = None
    spacing: tuple[float, ...] | None = None
    resample: bool = False
    overwrite: bool = False
    settings: Settings = field(default_factory=Settings)
    memory: int | None = None

    def __post_init__(self) -> None:
        if self.memory is not None:
            object.__setattr__(self, "memory", parse_memory(self.memory))
        if self.settings.flat and self.levelset is not None:
            raise RefusedError("flat: there is no surface, so LEVELSET is omitted: beltrami denoise --flat DATA -o OUT")
        if not self.settings.flat and self.levelset is None:
            raise RefusedError("LEVELSET is missing: give LEVELSET and DATA, or DATA alone with --flat")
        if self.settings.flat and self.mesh:
            raise RefusedError("flat: there is no surface, so there is no mesh to write; drop --mesh")
        if self.settings.flat and self.resample:
            raise RefusedError("flat: there is no level set's grid to resample onto; drop --resample")
        if self.settings.flat and (self.on or self.labels or self.between):
            raise RefusedError("flat: there is no surface; drop --on, --labels and --between")
        if self.labels and self.between:
            raise RefusedError("labels and between both say where in LEVELSET the surface is; give one of them")
        if self.frame not in (*FRAMES, None):
            raise RefusedError(f"frame: found {self.frame!r}; expected {' or '.join(FRAMES)}")

    @property
    def inputs(self) -> list[Path]:
        """LEVELSET (if any) and DATA."""
        return [path for path in (self.levelset, self.data) if path is not None]

    @property
    def all_inputs(self) -> list[Path]:
        """LEVELSET and DATA, then weights and mask, those there are, and the surfaces to put values on."""
        trust = (path for path in (self.weights, self.mask) if path is not None)
        return [*self.inputs, *trust, *(surface for surface, _ in self.on)]


# What a config file may say: section, key and the field of Job or Settings that it sets.
KEYS: dict[str, dict[str, str]] = {
    "input": {
        **{
            k: k
            for k in ("levelset", "labels", "between", "frame", "data", "map", "weights", "mask", "missing", "fill")
        },
        **{k: k for k in ("spacing", "resample", "inside")},
    },
    "output": {
        **{k: k for k in ("volume", "mesh", "filled", "report", "on", "structure")},
        **{k: k for k in ("outside", "overwrite", "precision")},
    },
    "flow": {"name": "flow", **{k: k for k in ("phi", "beta", "edge", "eps", "scheme", "dt", "flat", "fidelity")}},
    "time": {k: k for k in ("iterations", "time", "fwhm", "stop", "noise_sigma", "seed")},
    "band": {"half_width": "band", **{k: k for k in ("extension", "extend_every", "depth")}},
    "values": {k: k for k in ("kind", "period", "independent")},
    "run": {k: k for k in ("threads", "memory")},
}


def read_config(path: Path) -> dict[str, Any]:
    """The fields that the TOML file of one run sets, paths made relative to the file.

    Raises RefusedError as `read_tables` and `fields_of`, and where the file has [for_each], which makes many runs.
    """
    tables = read_tables(path)
    if "for_each" in tables:
        raise RefusedError(
            f"{path}: has [for_each], which makes many runs; expected a config of one run: for many, beltrami batch "
            f"{path}"
        )
    return fields_of(path, tables)


def read_tables(path: Path) -> dict[str, Any]:
    """What a TOML file holds, as it stands there; raises RefusedError where it is missing or is not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RefusedError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RefusedError(f"{path}: not a valid TOML file ({error}); correct it") from error


def fields_of(path: Path, tables: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that the tables of a config set, their paths made relative to `path`, the config's file.

    Raises RefusedError for an unknown section or key, and for a value that its field cannot hold.
    """
    given: dict[str, Any] = {}
    for section, table in tables.items():
        if section not in KEYS:
            raise RefusedError(f"{path}: unknown section [{section}]{nearest(section, [*KEYS, 'for_each'])}")
        if not isinstance(table, dict):
            raise RefusedError(f"{path}: found {section!r} as a key or a list; expected a section [{section}]")
        for key, value in table.items():
            if key not in KEYS[section]:
                raise RefusedError(f"{path}: unknown key {key!r} in [{section}]{nearest(key, KEYS[section])}")
            given[KEYS[section][key]] = _from_toml(path, section, key, value)
    return given


def make_job(given: Mapping[str, Any], *, in_config: bool = False) -> Job:
    """A checked Job from fields by name; DATA and OUT must be among them.

    in_config: the fields are those of a config file alone, and what is missing is missing there.
    """
    if in_config:
        _require_files(given)
    for name, what in (("data", "DATA"), ("volume", "OUT (-o FILE)")):
        if given.get(name) is None:
            raise RefusedError(f"{what} is missing: beltrami denoise LEVELSET DATA -o OUT")
    names = {f.name for f in fields(Settings)}
    settings = Settings(**{k: v for k, v in given.items() if k in names})
    return Job(**{k: v for k, v in given.items() if k not in names}, settings=settings)


def _require_files(given: Mapping[str, Any]) -> None:
    """Raise RefusedError, in the words of a config, where one of a run does not name its files."""
    keys = ["[input] data", "[output] volume", *([] if given.get("flat") else ["[input] levelset"])]
    for key in keys:
        if given.get(key.split()[1]) is None:
            surface = ", or flat = true in [flow] where there is no surface" if key.endswith("levelset") else ""
            raise RefusedError(f"{key} is missing; expected the name of a file{surface}")


def overlaid(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of `over` in place of those of `base`; what they displace goes with them.

    One way to say how long to run displaces the others, beta displaces edge and the reverse, another flow or kind the
    old one's parameters, flat all of the surface.
    """
    displaced: set[str] = set()
    durations = {"iterations", "time", "fwhm", "stop"}
    if durations & over.keys():
        displaced |= durations | ({"noise_sigma"} if over.get("stop") != "discrepancy" else set())
    if {"beta", "edge"} & over.keys():
        displaced |= {"beta", "edge"}
    if "flow" in over:
        slopes = {"beta", "edge"}
        takes = {"l2": set(), "auto": set(), "l1": {"eps"}, "tv": {"eps"}, "phi": {"phi", *slopes}}
        displaced |= {"phi", "eps", *slopes} - takes.get(over["flow"], slopes)
    if "kind" in over:
        own = {"circular": "period", "vector": "independent"}.get(over["kind"])
        displaced |= {"period", "independent"} - {own}
    if over.get("flat"):
        displaced |= {"levelset", "mesh", "on", "labels", "between", "resample"}
        displaced |= {"band", "extension", "extend_every", "depth"}
    if {"labels", "between"} & over.keys():
        displaced |= {"labels", "between"}
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


def parse_on(given: str, folder: Path = Path()) -> tuple[Path, Path]:
    """A surface and the file for the values at its vertices from "SURFACE=FILE", both relative to `folder`.

    Raises RefusedError for anything else.
    """
    surface, equals, file = (part.strip() for part in given.partition("="))
    if not (surface and equals and file) or "\0" in given:
        raise RefusedError(f"on: found {given!r}; expected SURFACE=FILE, as in lh.mid.surf.gii=lh.map.func.gii")
    return folder / surface, folder / file


def _numbers(given: Any) -> tuple[float, ...]:
    """Numbers from "A,B,...", a list or one number; raises TypeError or ValueError for anything else."""
    parts = given.split(",") if isinstance(given, str) else given if isinstance(given, list | tuple) else [given]
    if any(isinstance(part, bool) for part in parts):
        raise TypeError("a truth value is no number")
    return tuple(float(part) for part in parts)


def _from_toml(path: Path, section: str, key: str, value: Any) -> Any:
    """A TOML value as its field holds it."""
    where = f"{path}: [{section}] {key}"
    if key in ("resample", "overwrite", "flat", "independent"):
        if not isinstance(value, bool):
            raise RefusedError(f"{where}: found {value!r}; expected true or false")
        return value
    if key == "mesh":
        if value is False:
            return ()
        names = value if isinstance(value, list) else [value]
        return tuple(_path(path, where, name) for name in names)
    if key in ("levelset", "data", "weights", "mask", "volume", "filled", "report"):
        return _path(path, where, value)
    if key == "on":
        pairs = value if isinstance(value, list) else [value]
        if not all(isinstance(pair, str) for pair in pairs):
            raise RefusedError(f"{where}: found {value!r}; expected SURFACE=FILE, or a list of them")
        return tuple(parse_on(pair, path.parent) for pair in pairs)
    if key in ("labels", "between"):
        return ",".join(_text(where, part) for part in (value if isinstance(value, list) else [value]))
    if key == "map":
        return _text(where, value)
    if key == "structure" and not isinstance(value, str):
        raise RefusedError(f"{where}: found {value!r}; expected a name, as CortexLeft")
    if key == "frame" and value not in FRAMES:
        raise RefusedError(f"{where}: found {value!r}; expected {' or '.join(FRAMES)}")
    if key == "spacing":
        return parse_spacing(value)
    if key == "beta":
        return parse_beta(value)
    if key == "dt" and value == "auto":
        return None
    return value


def _text(where: str, value: Any) -> str:
    """A text or a whole number as text."""
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise RefusedError(f"{where}: found {value!r}; expected a text or a whole number")
    return str(value)


def _path(config: Path, where: str, value: Any) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise RefusedError(f"{where}: found {value!r}; expected the name of a file")
    return config.parent / value


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the known one that is most like it, or all of them."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; expected one of {', '.join(known)}"
