"""beltrami denoise: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from beltrami_cli.cli.common import Command, announce_compilation, frame_option, note, overwrite_option, say, short

FILE = click.Path(path_type=Path)


# Headings of --help, each by the first option under it.
HEADINGS = {
    "volume": "Files",
    "flow": "Flow",
    "iterations": "How long",
    "kind": "Values",
    "extension": "Surface and band",
    "outside": "Output and machine",
}


class Denoise(Command):
    """The command with its many options under headings."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        sections: dict[str, list[tuple[str, str]]] = {}
        heading = ""
        for option in self.get_params(ctx):
            heading = HEADINGS.get(option.name or "", heading)
            line = option.get_help_record(ctx)
            if line is not None and isinstance(option, click.Option):
                sections.setdefault(heading, []).append(line)
        for heading, lines in sections.items():
            with formatter.section(heading):
                formatter.write_dl(lines)


@click.command(cls=Denoise)
@click.argument("inputs", nargs=-1, type=FILE, metavar="LEVELSET DATA")
@click.option(
    "-o",
    "--output",
    "volume",
    type=FILE,
    metavar="OUT",
    help="The denoised volume (.nii.gz .mha .npy .mgz), or values at vertices (.func.gii .shape.gii .mgz lh.NAME).",
)
@click.option(
    "--mesh",
    type=FILE,
    multiple=True,
    help="The surface with the denoised values; may be repeated. Default: beside OUT.",
)
@click.option("--no-mesh", is_flag=True, default=None, help="Write no mesh.")
@click.option("--filled", type=FILE, help="A mask of the voxels or vertices that had no value and got one.")
@click.option(
    "--report",
    type=FILE,
    metavar="FILE.html|.png",
    help="A picture of the run: a page for any browser, or a sheet. Needs the extra [report].",
)
@click.option("--weights", type=FILE, help="How much each value of DATA counts: R^2, coherence ...; 0 or more.")
@click.option("--mask", type=FILE, help="Which values of DATA count: those where it is not 0. All else is missing.")
@click.option(
    "--on",
    multiple=True,
    metavar="SURFACE=FILE",
    help="Values at the vertices of your own surface, in their order, as .func.gii .shape.gii .mgz or lh.NAME; may be "
    "repeated.",
)
@click.option("--labels", metavar="L1,L2..", help="LEVELSET is a segmentation: these labels are inside.")
@click.option("--between", metavar="INNER,OUTER", help="The same, and the surface runs midway between the two labels.")
@click.option("--map", metavar="NAME|N", help="Which map of DATA at vertices, where the file has several.")
@frame_option
@click.option(
    "--structure",
    metavar="NAME",
    help="The part of the brain that GIFTI outputs name, as CortexLeft. Default: what the surface or its name says.",
)
@click.option(
    "--spacing",
    metavar="S|SX,SY,SZ",
    help="Voxel size in mm of .npy inputs (default: 1), or of the band around a surface with DATA at its vertices "
    "(default: 2/3 of its median edge).",
)
@click.option(
    "--resample", is_flag=True, default=None, help="Bring DATA, weights and mask onto LEVELSET's grid (trilinear)."
)
@click.option("--config", type=FILE, help="A TOML file with any of this; the command line overrides it.")
@overwrite_option
@click.option(
    "--flow",
    type=click.Choice(["beltrami", "l2", "l1", "tv", "phi", "auto"]),
    help="auto: l2, beltrami, tv or Perona-Malik, chosen by held-out data. Default: beltrami.",
)
@click.option(
    "--phi",
    type=click.Choice(["charbonnier", "perona-malik", "geman-mcclure", "weickert"]),
    help="The function of the flow phi. Default: perona-malik.",
)
@click.option(
    "--beta",
    metavar="B|A:B[:LAW]|B1,B2,..|auto",
    help="Keeps edges steeper than 1/beta (beta in mm per data unit): a number, a run from A to B (linear or "
    "geometric), equal stretches of several, or auto: chosen by held-out data. Default: auto.",
)
@click.option("--edge", type=float, metavar="SLOPE", help="The same as a slope in data units per mm: beta = 1/SLOPE.")
@click.option(
    "--eps",
    type=float,
    help="Slope (data units per mm) under which l1 and tv smooth. Default: a tenth of the data's median slope.",
)
@click.option(
    "--scheme",
    type=click.Choice(["symmetric", "paper"]),
    help="symmetric: second order (default). paper: Sec. 4.1, first order; with unit normals and beta |N|^2 as in "
    "Eq. 20, for the printed weights |N| blow up inside thin sulci.",
)
@click.option(
    "--fidelity",
    type=float,
    metavar="L",
    help="Pull back to DATA: adds L w (U0 - U) to the flow, L in 1/mm^2, w the weights; where w is 0 it paints in.",
)
@click.option("--dt", metavar="DT|auto", help="Time step in mm^2. Default: 0.9 of the stability bound.")
@click.option("--flat", is_flag=True, default=None, help="No surface: the flow of Eqs. 10-11; LEVELSET is omitted.")
@click.option("--iterations", type=int, help="How many steps. Default: 20.")
@click.option("--time", type=float, help="How long to flow, in mm^2, in place of --iterations.")
@click.option("--fwhm", type=float, help="The same as the FWHM in mm of the Gaussian that l2 would equal.")
@click.option(
    "--stop",
    type=click.Choice(["auto", "discrepancy", "decorrelation"]),
    help="Let the data say. auto: least error at held-out data. discrepancy: as much is removed as there is noise. "
    "decorrelation: what is removed is least correlated with what stays (l2, tv, phi).",
)
@click.option(
    "--noise-sigma", type=float, metavar="S", help="The noise in data units for discrepancy. Default: estimated."
)
@click.option("--seed", type=int, help="Of all that is drawn, as held-out data are. Default: 0.")
@click.option(
    "--kind",
    type=click.Choice(["scalar", "circular", "vector"]),
    help="circular: angles, which wrap. vector: the last axis of DATA (in a plane the third) holds channels, whose "
    "edges are shared. "
    "Default: scalar.",
)
@click.option("--period", metavar="P", help="Of circular data, in their unit: 360, 2pi, 24 ...")
@click.option("--independent", is_flag=True, default=None, help="A vector's channels run apart, as scalars do.")
@click.option(
    "--missing",
    type=float,
    metavar="VALUE",
    help="A value of DATA that means none, as NaN always does; in one channel, for all.",
)
@click.option(
    "--fill", type=float, metavar="MM", help="Fill in no farther than this along the surface. Default: no limit."
)
@click.option(
    "--extension",
    type=click.Choice(["closest-point", "pde", "none"]),
    help="How data are carried off the surface. Default: closest-point.",
)
@click.option("--extend-every", type=int, metavar="K", help="Steps between re-extensions, 0 for never. Default: 5.")
@click.option(
    "--depth",
    metavar="A:B",
    help="Average DATA along the normal from A to B mm (outward is positive) before the flow, as in --depth=-2:2.",
)
@click.option(
    "--band",
    type=float,
    metavar="MM",
    help="Half-width of the band. Default: 4 voxels of the largest spacing, or what --depth needs.",
)
@click.option("--inside", type=click.Choice(["negative", "positive"]), help="Psi's sign inside. Default: negative.")
@click.option(
    "--outside", type=click.Choice(["nan", "zero", "keep"]), help="What OUT holds beyond the band. Default: nan."
)
@click.option(
    "--precision", type=click.Choice(["float32", "float64"]), help="Of computation and OUT. Default: float32."
)
@click.option("--threads", type=int, help="Default: the CPUs that the process may use.")
@click.option(
    "--memory", metavar="LIMIT", help="Refuse a run that is estimated to need more than this: 8G, 500M. Default: none."
)
def denoise(inputs: tuple[Path, ...], config: Path | None, quiet: bool, verbose: int, **options: Any) -> int:
    """Denoise DATA along the surface where LEVELSET is zero, keeping edges.

    Both are volumes on one grid (.nii .nii.gz .hdr .mha .mhd .npy .mgz; in a plane also .png). LEVELSET is negative
    inside; NaN in DATA is missing and gets filled. Writes OUT, a mesh with the denoised value at every vertex, and a
    JSON record beside OUT.

    LEVELSET may as well be a segmentation (a mask, or labels with --labels or --between) or a surface (.surf.gii .ply
    .obj .stl .vtk, FreeSurfer's lh.white); DATA then may have another grid or, on a surface, be values at its vertices
    (.func.gii .shape.gii .mgz, FreeSurfer's lh.thickness), and OUT such a file.

    \b
        beltrami denoise psi.nii.gz map.nii.gz -o denoised.nii.gz
        beltrami denoise lh.white lh.thickness -o lh.thickness_denoised
    """
    from beltrami_cli.config import make_job, overlaid, read_config
    from beltrami_cli.pipeline import run
    from beltrami_cli.progress import iteration_bar

    given = _given(inputs, options)
    job = make_job(overlaid(read_config(config), given) if config else given)
    announce_compilation(quiet)
    with iteration_bar("flow", quiet=quiet) as observer:
        result = run(job, observer=observer, notify=lambda line: note(quiet, f"warning: {line}"))
    if verbose:
        _tell_details(result.record)
    for line in summary(result.record):
        say(quiet, line)
    return 0


def summary(record: dict[str, Any]) -> list[str]:
    """What was written, what was done, and what was chosen, if anything was."""
    removed = record["Removed"]["rms"]
    amount = "no noise measured" if removed is None else f"noise removed {removed:.4g} rms"
    done = [
        amount + _noise(record.get("Noise", {})),
        *_smoothness(record.get("Smoothness", {})),
        f"{record['Iterations']} iterations",
        f"stopped by {record['StopReason']}",
        f"{sum(record['Seconds'].values()):.1f} s",
    ]
    lines = [f"wrote {short(', '.join(record['Outputs']))}", ", ".join(done)]
    if record.get("Choice"):
        lines.append(f"chosen by held-out data: {_combination(record['Choice'])}")
    return lines


def _noise(found: dict[str, Any]) -> str:
    """The noise as estimated, a number per channel; of many channels the least and the most."""
    sd = [value for value in found.get("sd") or () if value is not None]
    if not sd:
        return ""
    told = " and ".join(f"{value:.4g}" for value in sd) if len(sd) <= 3 else f"{min(sd):.4g} to {max(sd):.4g}"
    return f" of {told} estimated"


def _smoothness(found: dict[str, Any]) -> list[str]:
    before, after = found.get("before_mm"), found.get("after_mm")
    if after is None:
        return []
    return [f"smoothness {'' if before is None else f'{before:.3g} to '}{after:.3g} mm FWHM"]


def _combination(row: dict[str, Any]) -> str:
    """A chosen or tried combination in words: the flow, beta and iterations, those it has."""
    flow, beta, iterations = (row.get(name) for name in ("flow", "beta", "iterations"))
    words = [
        row.get("phi") or flow if flow == "phi" else flow,
        None if beta is None else f"beta {beta:.4g}",
        None if iterations is None else f"{iterations} iterations",
    ]
    return ", ".join(word for word in words if word)


def _given(inputs: tuple[Path, ...], options: dict[str, Any]) -> dict[str, Any]:
    """The fields that the command line sets."""
    from beltrami_cli.config import parse_on, parse_spacing

    if len(inputs) > 2:
        extra = " ".join(map(str, inputs[2:]))
        raise click.UsageError(f"found {extra} after LEVELSET and DATA; expected two files")
    given = {name: value for name, value in options.items() if value is not None and value != ()}
    given.update(zip(("data", "levelset"), reversed(inputs), strict=False))
    if given.pop("no_mesh", False):
        if "mesh" in given:
            raise click.UsageError("--mesh and --no-mesh contradict each other; give one of them")
        given["mesh"] = ()
    if "on" in given:
        given["on"] = tuple(map(parse_on, given["on"]))
    if "spacing" in given:
        given["spacing"] = parse_spacing(given["spacing"])
    if "dt" in given:
        given["dt"] = None if given["dt"] == "auto" else _number("--dt", given["dt"])
    return given


def _number(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise click.UsageError(f"{option}: found {text!r}; expected a number of mm^2, or auto") from None


def _tell_details(record: dict[str, Any]) -> None:
    band, each = record["Band"], record["PerIteration"]
    note(
        False,
        f"band: {band['entries']} entries in {band['voxels']} voxels within {band['half_width_mm']:g} mm of "
        f"{band['surface_vertices']} vertices; {band['filled_voxels']} voxels filled",
    )
    if each["beta"]:
        note(
            False,
            f"flow: dt {each['dt'][0]:.5g} mm^2, beta {each['beta'][0]:.5g} to {each['beta'][-1]:.5g}, "
            f"typical slope of the data {record['TypicalSlope']:.5g} per mm",
        )
    for row in (record.get("Choice") or {}).get("table") or ():
        error = "did not run" if row["error"] is None else f"error {row['error']:.5g}"
        note(False, f"held out: {_combination(row)}: {error}")
    phases = ", ".join(f"{name} {seconds:.2f}" for name, seconds in record["Seconds"].items())
    note(False, f"seconds: {phases}; peak memory {record['PeakMemoryMiB']} MiB")
