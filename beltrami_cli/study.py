"""Configs into jobs: [for_each], the templates that it fills, and the patterns that bind names from paths.

[for_each]
hemi = ["lh", "rh"]                                       # a list: every value
data = "raw/sub-{subject}/*_hemi-{hemi}_angle.nii.gz"     # a pattern: every file, which binds subject and data

[output]
volume = "out/sub-{subject}_hemi-{hemi}.nii.gz"           # a template: filled in for every combination
"""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import Any

from beltrami_cli import formats
from beltrami_cli.config import Job, fields_of, make_job, nearest, read_tables
from beltrami_cli.errors import RefusedError
from beltrami_cli.record import sidecar_of

Value = str | int | float | bool
Combination = dict[str, Value]  # what each name of [for_each] stands for in one job

_TOKEN = re.compile(
    r"(?P<brace>\{\{|\}\})|\{(?P<name>[^{}]*)\}|(?P<lone>[{}])"
    r"|(?P<deep>(?:(?<=/)|^)\*\*(?:/|$))|(?P<wild>\*+)|(?P<any>\?)|(?P<text>[^{}*?]+)"
)


@dataclass(frozen=True)
class Planned:
    """A job of a study and its name there. config: the file that it comes from, as given; the job's paths are absolute.

    name: what [for_each] binds, "subject=01 hemi=lh"; with several configs the config's name stands before it,
    "study: subject=01 hemi=lh"; without [for_each] it is the config's name alone.
    """

    name: str
    config: Path
    job: Job


def read_study(configs: Sequence[Path]) -> list[Planned]:
    """The jobs of all configs: in their order, and within one the product of [for_each], its last name fastest.

    A list under [for_each] gives its values (texts, whole numbers, floats, booleans). A text is a pattern, relative to
    the config's folder: `*`, `?` and `**` are as in shells, {name} binds one or more characters but no slash, as few
    as fit, and the same text wherever it stands. Every file found gives one combination, in the order of the paths,
    which also binds the pattern's own name to the path. Hidden files are left out. Names that stand before a pattern
    are filled into it, whether a list or another pattern binds them: it is then searched for each of their values, and
    one for which nothing is found is refused, for whoever lists a subject wants it. To take what there is, leave the
    name to the pattern alone.

    {NAME} is then replaced in every other text of the config. Where it is the whole text, the value keeps its type.
    {{ and }} are braces. In a config without [for_each] nothing is replaced.

    Raises RefusedError as `config.read_tables`, `config.fields_of` and `config.make_job`, naming the combination; for
    a [for_each] or a template that makes no sense; and where two jobs write one file, or one reads what any writes.
    """
    _require_distinct(configs)
    planned = [
        Planned(name, config, job)
        for config, stem in zip(configs, _stems(configs), strict=True)
        for name, job in _jobs(config, stem, several=len(configs) > 1)
    ]
    _require_apart(planned)
    return planned


def part(planned: Sequence[Planned], given: str) -> list[Planned]:
    """Every N-th job from the K-th, for "K/N" with K from 1 to N; raises RefusedError for anything else.

    The parts 1/N to N/N hold every job once. Where there are fewer jobs than N, the last parts are empty.
    """
    match = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", given)
    first, step = map(int, match.groups()) if match else (0, 0)
    if not 1 <= first <= step:
        raise RefusedError(f"part: found {given!r}; expected K/N with K from 1 to N: 3/10 is the third of ten parts")
    return list(planned[first - 1 :: step])


def files_of(planned: Iterable[Planned]) -> set[str]:
    """Every file that the jobs are made of, read or write, as far as names tell, links resolved."""
    return {os.path.realpath(file) for each in planned for file in (each.config, *each.job.all_inputs, *_written(each))}


def _jobs(config: Path, stem: str, *, several: bool) -> Iterator[tuple[str, Job]]:
    """The jobs of a config with their names."""
    tables = read_tables(config)
    if "for_each" not in tables:
        yield stem, _job(config, str(config), tables)
        return
    loop = tables.pop("for_each")
    combinations = _combinations(config, loop)
    for name, known in zip(_names(config, loop, combinations), combinations, strict=True):
        job = _job(config, f"{config}: {name}", _filled(tables, known, config))
        yield f"{stem}: {name}" if several else name, job
    used = set(_names_in([tables, [given for given in loop.values() if isinstance(given, str)]], config))
    for name, given in loop.items():
        if isinstance(given, list) and name not in used:
            raise RefusedError(
                f"{config}: [for_each] {name} is used nowhere, so that its jobs would be one; expected {{{name}}} in "
                "another section; use it, or drop the list"
            )


def _job(config: Path, where: str, tables: Mapping[str, Any]) -> Job:
    try:
        given = fields_of(config, tables)
        return make_job({name: _absolute(value) for name, value in given.items()}, in_config=True)
    except RefusedError as error:
        raise RefusedError(f"{where}: {str(error).removeprefix(f'{config}: ')}") from None


def _absolute(value: Any) -> Any:
    """The value of a field, its paths absolute; `..` stays, for behind a link it means another folder."""
    if isinstance(value, tuple):
        return tuple(map(_absolute, value))
    return value.absolute() if isinstance(value, Path) else value


def _combinations(config: Path, loop: Any) -> list[Combination]:
    if not isinstance(loop, dict) or not loop:
        raise RefusedError(f'{config}: [for_each]: found {loop!r}; expected NAME = [values] or NAME = "pattern"')
    combinations: list[Combination] = [{}]
    for name, given in loop.items():
        where = f"{config}: [for_each] {name}"
        if not name.isidentifier():
            raise RefusedError(f"{where}: not a name; expected letters, digits and _, and no digit first")
        if isinstance(given, str):
            _require_names_to_bind(config, name, given, loop, combinations[0])
            combinations = _searched(config, name, given, combinations)
        else:
            values = _values(where, given)
            combinations = [{**known, name: value} for known in combinations for value in values]
    return combinations


def _values(where: str, given: Any) -> list[Value]:
    if not isinstance(given, list) or not given:
        raise RefusedError(f"{where}: found {given!r}; expected a list of values, or a pattern of paths as a text")
    for value in given:
        if not isinstance(value, str | int | float):
            raise RefusedError(f"{where}: found {value!r}; expected texts, numbers, true or false")
    twice = [text for text, count in Counter(map(_text, given)).items() if count > 1]
    if twice:
        raise RefusedError(f"{where}: found {twice[0]!r} twice; expected every value once")
    return given


def _require_names_to_bind(config: Path, name: str, pattern: str, loop: Iterable[str], known: Iterable[str]) -> None:
    """Raise RefusedError where a pattern would bind what is no name, or what is bound elsewhere."""
    for bound in _names_in(pattern, config):
        if bound not in known and not bound.isidentifier():
            raise RefusedError(
                f"{config}: [for_each] {name}: found {{{bound}}} in the pattern {pattern!r}; expected a name of "
                "letters, digits and _, and no digit first"
            )
        if bound not in known and bound in loop:
            raise RefusedError(
                f"{config}: [for_each] {bound} is bound twice: it stands there by itself, and the pattern of {name} "
                f"binds it; put {bound} before {name} to have it filled in there, or rename one of them"
            )


def _searched(config: Path, name: str, pattern: str, combinations: list[Combination]) -> list[Combination]:
    """The combinations, each with every file that the pattern finds when filled in with it."""
    within = [each for each in dict.fromkeys(_names_in(pattern, config)) if each in combinations[0]]
    found: dict[tuple[str, ...], list[Combination]] = {}
    extended = []
    for known in combinations:
        key = tuple(_text(known[each]) for each in within)
        if key not in found:
            found[key] = _found(config, name, pattern, {each: known[each] for each in within})
        extended += [{**known, **bound} for bound in found[key]]
    return extended


def _found(config: Path, name: str, pattern: str, known: Combination) -> list[Combination]:
    """What every file that matches binds: the pattern's names, and `name` to its path, in the order of the paths."""
    wild, exact = _as_glob(config, name, pattern, known)
    files = {PurePath(file).as_posix() for file in glob.glob(wild, root_dir=config.parent, recursive=True)}
    matches = [exact.fullmatch(file) for file in sorted(files) if os.path.isfile(config.parent / file)]
    found = [{**match.groupdict(), name: match.string} for match in matches if match]
    if not found:
        those = f" with {_label(known)}" if known else ""
        raise RefusedError(
            f"{config}: [for_each] {name}: no file found for {pattern!r}{those} in {config.parent.absolute()}; "
            "expected one (* ? ** and {name} match all but hidden names), or a list of values in brackets"
        )
    return found


def _as_glob(config: Path, name: str, pattern: str, known: Combination) -> tuple[str, re.Pattern[str]]:
    """The pattern as a glob that finds too much, and as an expression that binds its names."""
    wild = exact = ""
    bound: set[str] = set()
    before = "text"
    for kind, text in _tokens(PurePath(pattern).as_posix(), config):
        if kind == "name" and text in known:
            kind, text = "text", _text(known[text])
        elif kind == "name" and text in bound:
            kind = "again"
        if {before, kind} <= {"name", "wild"}:
            raise RefusedError(
                f"{config}: [for_each] {name}: found two that match anything side by side in {pattern!r}, {{name}} "
                "beside * or another {name}; expected text between them, to tell where the name ends"
            )
        match kind:
            case "text":
                parts = glob.escape(text), re.escape(text)
            case "name":
                parts = "*", f"(?P<{text}>[^/]+?)"
            case "again":
                parts = "*", f"(?P={text})"
            case "deep":
                parts = text, "(?:[^/]+/)*" if text.endswith("/") else ".*"
            case "wild":
                parts = "*", "[^/]*"
            case _:
                parts = "?", "[^/]"
        wild, exact, before = wild + parts[0], exact + parts[1], kind
        bound |= {text} if kind == "name" else set()
    return wild, re.compile(exact, re.DOTALL)


def _filled(value: Any, known: Combination, config: Path) -> Any:
    """A value of a config with its templates filled in, in lists and tables too."""
    if isinstance(value, dict):
        return {key: _filled(each, known, config) for key, each in value.items()}
    if isinstance(value, list):
        return [_filled(each, known, config) for each in value]
    if not isinstance(value, str):
        return value
    tokens = _tokens(value, config)
    for kind, text in tokens:
        if kind == "name" and text not in known:
            raise RefusedError(
                f"{config}: found {{{text}}} in {value!r}, which [for_each] does not bind{nearest(text, known)} "
                "(a brace itself is {{ or }})"
            )
    if len(tokens) == 1 and tokens[0][0] == "name":
        return known[tokens[0][1]]
    return "".join(_text(known[text]) if kind == "name" else text for kind, text in tokens)


def _names_in(value: Any, config: Path) -> Iterator[str]:
    """Every {name} in the texts of a value."""
    if isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _names_in(each, config)
    elif isinstance(value, str):
        yield from (text for kind, text in _tokens(value, config) if kind == "name")


def _tokens(template: str, config: Path) -> list[tuple[str, str]]:
    """(kind, text) of each piece of a template or pattern: "text", "name", "wild" (*), "any" (?) or "deep" (**)."""
    tokens = []
    for match in _TOKEN.finditer(template):
        kind, text = str(match.lastgroup), str(match[str(match.lastgroup)])
        if kind == "lone":
            raise RefusedError(
                f"{config}: found a lone {text} in {template!r}; expected {{NAME}}; write {text * 2} for a brace itself"
            )
        tokens.append(("text", text[0]) if kind == "brace" else (kind, text))
    return tokens


def _text(value: Value) -> str:
    """A value as a template holds it, booleans as in TOML."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _stems(configs: Sequence[Path]) -> list[str]:
    """What each config is called: its name without the suffix, with as many folders as tell it from the others."""
    parts = [config.absolute().with_suffix("").parts for config in configs]
    for count in range(1, max(map(len, parts), default=0) + 1):
        stems = ["/".join(each[-count:]) for each in parts]
        if len(set(stems)) == len(stems):
            return stems
    return list(map(str, configs))


def _names(config: Path, loop: Mapping[str, Any], combinations: list[Combination]) -> list[str]:
    """What each combination is called; the path that a pattern finds tells only what the names in it do not."""
    paths = {name for name, given in loop.items() if isinstance(given, str) and any(_names_in(given, config))}
    short = [_label({name: value for name, value in known.items() if name not in paths}) for known in combinations]
    count = Counter(short)
    return [_label(known) if count[name] > 1 else name for name, known in zip(short, combinations, strict=True)]


def _label(known: Combination) -> str:
    return " ".join(f"{name}={_text(value)}" for name, value in known.items())


def _require_distinct(configs: Sequence[Path]) -> None:
    twice = [config for config, count in Counter(map(os.path.realpath, configs)).items() if count > 1]
    if twice:
        raise RefusedError(f"{twice[0]}: given twice; expected every config once")


def _require_apart(planned: list[Planned]) -> None:
    """Raise RefusedError where two jobs write one file, or one reads what any of them writes."""
    real = cache(os.path.realpath)
    outputs = [(each, file) for each in planned for file in _written(each)]
    writer: dict[str, Planned] = {}
    for each, file in outputs:
        writer.setdefault(real(file), each)
    # Inputs first: that they would be lost is worse than that two jobs write one file, which may be true as well.
    for each, file in [(reader, file) for reader in planned for file in reader.job.all_inputs]:
        source = writer.get(real(file))
        if source is each:
            raise RefusedError(
                f"{each.config}: {each.name}: {file} is an input and an output, and inputs are never changed; choose "
                "another name for the output"
            )
        if source is not None:
            raise RefusedError(
                f"{each.config}: {each.name} reads {file}, which {source.name} writes; jobs of a batch run in any "
                "order: narrow the pattern, or run two batches"
            )
    for each, file in outputs:
        other = writer[real(file)]
        if other is not each:
            raise RefusedError(
                f"{each.config}: {other.name} and {each.name} both write {file}; expected outputs of their own for "
                "every job: give each another name, as by {NAME} of [for_each]"
            )


def _written(planned: Planned) -> list[Path]:
    """Every file that a job writes, as far as its names tell; raises RefusedError for a suffix that is not written.

    Of a curve, which only its file tells, the mesh is taken to have the name of a surface's; its sidecar is right.
    """
    job = planned.job
    volumes = [job.volume, *([job.filled] if job.filled else [])]
    try:
        outputs = [file for volume in volumes for file in _volume_files(volume)]
        meshes = job.mesh
        if meshes is None:
            meshes = () if job.settings.flat else (formats.mesh_beside(job.volume),)
        # Values at vertices are in OUT already, not beside the mesh too.
        bare = job.mesh is None and outputs[0].name.lower().endswith(".gii")
        outputs += [file for mesh in meshes for file in formats.mesh_files(mesh, values=not bare)]
    except RefusedError as error:
        raise RefusedError(f"{planned.config}: {planned.name}: {error}") from None
    pictures = [job.report] if job.report else []
    return [*outputs, *(file for _, file in job.on), *pictures, sidecar_of(job.volume)]


def _volume_files(path: Path) -> list[Path]:
    """Every file of an output that is a volume, or values at vertices."""
    try:
        return formats.volume_files(path)
    except RefusedError:
        with suppress(RefusedError):
            return formats.overlay_files(path)
        raise
