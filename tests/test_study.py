"""Configs into jobs: lists, templates, patterns, names, and the checks over all jobs."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest

from beltrami_cli.config import Settings, make_job, read_config
from beltrami_cli.errors import RefusedError
from beltrami_cli.study import Planned, files_of, part, read_study

INPUT = """
[input]
levelset = "psi.nii.gz"
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(name: str, *texts: str) -> Path:
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(texts), encoding="utf-8")
    return path


def touch(*names: str) -> None:
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()


def study(*texts: str) -> list[Planned]:
    return read_study([write("study.toml", *texts)])


def writing(out: str, *more: str) -> str:
    """A config of one run that writes `out`."""
    return "\n".join([INPUT, "data = 'd.npy'", "[output]", f"volume = '{out}'", *more])


def refusal(*texts: str) -> str:
    with pytest.raises(RefusedError) as refused:
        study(*texts)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def names(planned: list[Planned]) -> list[str]:
    return [each.name for each in planned]


def found(pattern: str, *, out: str = "{data}.nii.gz") -> list[str]:
    """The paths that a pattern binds, as the jobs have them, relative to the folder."""
    planned = study(f"[for_each]\ndata = '{pattern}'", INPUT, "data = '{data}'", f"[output]\nvolume = 'out/{out}'")
    return [each.job.data.relative_to(Path.cwd()).as_posix() for each in planned]


# Lists and templates


def test_product_in_the_order_written(folder):
    planned = study(
        "[for_each]\nsubject = ['02', '01']\nhemi = ['lh', 'rh']\nrun = [1, 2]",
        INPUT,
        "data = 'sub-{subject}/{hemi}_{run}.nii.gz'\n[output]\nvolume = 'out/{subject}{hemi}{run}.nii.gz'",
    )
    expected = list(product(["02", "01"], ["lh", "rh"], [1, 2]))
    assert names(planned) == [f"subject={s} hemi={h} run={r}" for s, h, r in expected]
    assert [each.job.data for each in planned] == [folder / f"sub-{s}/{h}_{r}.nii.gz" for s, h, r in expected]
    assert [each.job.volume for each in planned] == [folder / f"out/{s}{h}{r}.nii.gz" for s, h, r in expected]
    assert {each.config for each in planned} == {Path("study.toml")}


def test_templates_in_lists_and_tables_and_text_of_every_type(folder):
    (first, second) = study(
        "[for_each]\nn = [1, 2]\nb = [0.5]\nyes = [true]",
        INPUT,
        "data = 'd.npy'\nlabels = ['{n}', 5]\n",
        "[output]\nvolume = '{n}_{b}_{yes}.npy'\nmesh = ['{n}.ply', '{n}.obj']\non = ['s.ply={n}.func.gii']",
        "[flow]\nbeta = {start = '{b}', stop = '{n}'}",
    )
    assert first.job.volume == folder / "1_0.5_true.npy"
    assert second.job.mesh == (folder / "2.ply", folder / "2.obj")
    assert second.job.on == ((folder / "s.ply", folder / "2.func.gii"),)
    assert (first.job.labels, second.job.labels) == ("1,5", "2,5")
    assert second.job.settings == Settings(beta="0.5:2")


def test_a_whole_text_takes_the_value_with_its_type():
    planned = study(
        "[for_each]\nn = [5, 10]\nbeta = ['auto', 0.25]\nmesh = [false]\nreplace = [true]",
        INPUT,
        "data = 'd.npy'\n[output]\nvolume = '{n}{beta}.npy'\nmesh = '{mesh}'\noverwrite = '{replace}'",
        "[flow]\nbeta = '{beta}'\n[time]\niterations = '{n}'",
    )
    assert [each.job.settings.iterations for each in planned] == [5, 5, 10, 10]
    assert [each.job.settings.beta.values for each in planned] == [(), (0.25,)] * 2
    assert {(each.job.mesh, each.job.overwrite) for each in planned} == {((), True)}
    assert names(planned)[1] == "n=5 beta=0.25 mesh=false replace=true"


def test_braces_are_doubled_only_where_for_each_stands(folder):
    (one,) = study("[for_each]\nn = [1]", INPUT, "data = '{{{n}}}.npy'\n[output]\nvolume = '{{n}}{n}.npy'")
    assert (one.job.data, one.job.volume) == (folder / "{1}.npy", folder / "{n}1.npy")
    (one,) = study(INPUT, "data = '{{d}}.npy'\n[output]\nvolume = '{o.npy'")
    assert (one.job.data, one.job.volume) == (folder / "{{d}}.npy", folder / "{o.npy")


def test_values_of_lists_are_no_templates(folder):
    (one,) = study("[for_each]\nn = ['{x}']", INPUT, "data = 'd.npy'\n[output]\nvolume = '{n}.npy'")
    assert one.job.volume == folder / "{x}.npy"


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        ("n = []", ["n: found []", "list of values"]),
        ("n = [[1, 2]]", ["n: found [1, 2]", "texts, numbers"]),
        ("n = [{a = 1}]", ["n: found {'a': 1}"]),
        ("n = [1, 2024-01-01]", ["n: found datetime.date"]),
        ("n = 3", ["n: found 3", "list of values"]),
        ("n = {a = 1}", ["n: found {'a': 1}", "list"]),
        ("n = ['1', 1]", ["'1' twice"]),
        ("'sub-id' = ['1']", ["sub-id: not a name"]),
        ("1n = ['1']", ["1n: not a name"]),
        ("", ["[for_each]: found {}", "NAME = [values]"]),
        ("n = [1]\nm = [1, 2]", ["[for_each] m is used nowhere", "{m}"]),
    ],
)
def test_for_each_that_cannot_be(loop, words):
    message = refusal(f"[for_each]\n{loop}", INPUT, "data = 'd.npy'\n[output]\nvolume = 'o{n}.npy'")
    assert message.startswith("study.toml: [for_each]")
    assert [word for word in words if word not in message] == []


def test_for_each_that_is_no_table():
    assert "study.toml: [for_each]: found [1]" in refusal("for_each = [1]")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{subjct}.npy", ["{subjct}", "did you mean 'subject'?"]),
        ("{}.npy", ["{} in '{}.npy'", "expected one of subject, hemi"]),
        ("{ subject }.npy", ["did you mean 'subject'?"]),
        ("{subject.npy", ["a lone {", "'{subject.npy'", "{{"]),
        ("subject}.npy", ["a lone }", "}}"]),
        ("{{subject}.npy", ["a lone }"]),
    ],
)
def test_template_that_cannot_be(text, words):
    message = refusal(
        "[for_each]\nsubject = ['01']\nhemi = ['lh']", INPUT, f"data = '{{hemi}}'\n[output]\nvolume = '{text}'"
    )
    assert message.startswith("study.toml: found ")
    assert [word for word in words if word not in message] == []


# Patterns


def test_pattern_binds_names_and_its_own_to_the_path(folder):
    touch(
        "raw/sub-02/ses-1_hemi-lh_angle.nii.gz", "raw/sub-01/x_hemi-rh_angle.nii.gz", "raw/sub-01/x_hemi-lh_r2.nii.gz"
    )
    touch("raw/sub-01/deeper/x_hemi-lh_angle.nii.gz", "raw/sub-/x_hemi-lh_angle.nii.gz")
    planned = study(
        "[for_each]\ndata = 'raw/sub-{subject}/*_hemi-{hemi}_angle.nii.gz'\nn = [1, 2]",
        INPUT,
        "data = '{data}'\n[output]\nvolume = 'out/sub-{subject}_{hemi}_{n}.nii.gz'",
    )
    assert names(planned) == [f"{who} n={n}" for who in ("subject=01 hemi=rh", "subject=02 hemi=lh") for n in (1, 2)]
    assert planned[0].job.data == folder / "raw/sub-01/x_hemi-rh_angle.nii.gz"
    assert planned[3].job.volume == folder / "out/sub-02_lh_2.nii.gz"


def test_names_as_in_bids(folder):
    stem = "sub-{subject}_ses-{session}_hemi-{hemi}"
    pattern = f"sub-{{subject}}/ses-{{session}}/func/{stem}_desc-angle.func.gii"
    expected = [(s, e, h) for s in ("01", "12a") for e in ("1", "pre") for h in "LR"]
    for s, e, h in expected:
        touch(pattern.format(subject=s, session=e, hemi=h))
    touch("sub-01/ses-1/func/sub-02_ses-1_hemi-L_desc-angle.func.gii")  # of another subject than its folder
    touch(
        "sub-01/ses-1/func/sub-01_ses-1_hemi-L_desc-r2.func.gii",
        "sub-01/ses-1/func/sub-01_ses-1_hemi-L_desc-angle.json",
    )
    planned = study(
        f"[for_each]\ndata = '{pattern}'",
        "[input]\nlevelset = 'sub-{subject}/anat/sub-{subject}_hemi-{hemi}_white.surf.gii'\ndata = '{data}'",
        f"[output]\nvolume = 'derivatives/{stem}_desc-denoised.func.gii'",
    )
    assert names(planned) == [f"subject={s} session={e} hemi={h}" for s, e, h in expected]
    assert planned[5].job.levelset == folder / "sub-12a/anat/sub-12a_hemi-R_white.surf.gii"
    assert planned[5].job.volume == folder / "derivatives/sub-12a_ses-1_hemi-R_desc-denoised.func.gii"


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("*.npy", ["x.npy", "x[1].npy", "x{1}.npy", "y.npy"]),
        ("./*.npy", ["x.npy", "x[1].npy", "x{1}.npy", "y.npy"]),
        ("?.npy", ["x.npy", "y.npy"]),
        ("[xy].npy", None),  # brackets stand for themselves
        ("x[1].npy", ["x[1].npy"]),
        ("x{{1}}.npy", ["x{1}.npy"]),
        ("x.npy", ["x.npy"]),
        ("*/x.npy", ["a/x.npy"]),
        ("**/x.npy", ["a/b/c/x.npy", "a/b/x.npy", "a/x.npy", "x.npy"]),
        ("a/**/c/*.npy", ["a/b/c/x.npy"]),
        ("a//b/./*.npy", ["a/b/x.npy"]),
        ("a/**", ["a/b/c/x.npy", "a/b/x.npy", "a/x.npy"]),
        ("{f}/x.npy", ["a/x.npy"]),
        ("**/{f}/x.npy", ["a/b/c/x.npy", "a/b/x.npy", "a/x.npy"]),
        ("{f}.npy", ["x.npy", "x[1].npy", "x{1}.npy", "y.npy"]),
        (".cache/{f}.npy", [".cache/x.npy"]),  # named by its own name
        ("**/z.npy", None),
        ("a", None),  # a folder
        ("", None),
    ],
)
def test_what_a_pattern_finds(pattern, expected):
    touch("x.npy", "y.npy", "x[1].npy", "x{1}.npy", "a/x.npy", "a/b/x.npy", "a/b/c/x.npy")
    touch(".x.npy", ".cache/x.npy", ".o.nii.gz.partial/x.npy", "a/.b/x.npy")  # hidden
    if expected is None:
        with pytest.raises(RefusedError, match="no file found"):
            found(pattern)
    else:
        assert found(pattern) == expected


def test_patterns_reach_outside_the_configs_folder(folder):
    touch("raw/a.npy", "raw/b.npy")
    texts = INPUT, "data = '{data}'\n[output]\nvolume = '{n}.nii.gz'"
    planned = read_study([write("configs/up.toml", "[for_each]\ndata = '../raw/{n}.npy'", *texts)])
    assert [each.job.data for each in planned] == [folder / "configs/../raw/a.npy", folder / "configs/../raw/b.npy"]
    planned = read_study([write("configs/whole.toml", f"[for_each]\ndata = '{folder}/raw/{{n}}.npy'", *texts)])
    assert [each.job.data for each in planned] == [folder / "raw/a.npy", folder / "raw/b.npy"]


def test_a_name_takes_as_little_as_fits():
    touch("sub-01_run-2_hemi-lh_angle.npy", "sub-02_hemi-lh_angle.npy", "a_b_c.npy")
    texts = INPUT, "data = '{data}'\n[output]\nvolume = '{subject}.nii.gz'"
    assert names(study("[for_each]\ndata = 'sub-{subject}_*angle.npy'", *texts)) == ["subject=01", "subject=02"]
    planned = study("[for_each]\ndata = '{subject}_{rest}.npy'", *texts[:1], "data='d'\n[output]\nvolume='{data}.nii'")
    assert "subject=a rest=b_c" in names(planned)


def test_names_before_a_pattern_are_filled_in(folder):
    touch(
        "raw/1/lh.npy",
        "raw/1/rh.npy",
        "raw/2/lh.npy",
        "raw/3/lh.npy",
        "surf/1.lh.ply",
        "surf/1.rh.ply",
        "surf/2.lh.ply",
    )
    planned = study(
        "[for_each]\nsubject = [2, 1]\ndata = 'raw/{subject}/{hemi}.npy'\nwhite = 'surf/{subject}.{hemi}.ply'",
        "[input]\nlevelset = '{white}'\ndata = '{data}'\n[output]\nvolume = '{subject}{hemi}.npy'",
    )
    assert names(planned) == ["subject=2 hemi=lh", "subject=1 hemi=lh", "subject=1 hemi=rh"]
    assert [each.job.levelset for each in planned] == [folder / f"surf/{who}.ply" for who in ("2.lh", "1.lh", "1.rh")]


def test_a_value_that_is_listed_must_be_found(folder):
    touch("raw/1.npy")
    message = refusal(
        "[for_each]\ns = [1, 4]\ndata = 'raw/{s}.npy'", INPUT, "data='{data}'\n[output]\nvolume='{s}.nii'"
    )
    assert "data: no file found for 'raw/{s}.npy' with s=4 in " + str(folder) in message


def test_two_files_of_one_name_are_told_apart_by_their_paths():
    touch("a/1.npy", "b/1.npy", "b/2.npy")
    planned = study("[for_each]\nd = '*/{n}.npy'", INPUT, "data = '{d}'\n[output]\nvolume = 'out/{d}.nii.gz'")
    assert names(planned) == ["n=1 d=a/1.npy", "n=1 d=b/1.npy", "n=2"]
    assert names(study("[for_each]\nd = 'b/*.npy'", INPUT, "data = '{d}'\n[output]\nvolume = '{d}.nii.gz'")) == [
        "d=b/1.npy",
        "d=b/2.npy",
    ]


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        ("d = 'raw/{s}/*.nii'", ["d: no file found for 'raw/{s}/*.nii' in /", "hidden", "list of values"]),
        ("d = '{s}*.npy'", ["side by side", "'{s}*.npy'", "text between them"]),
        ("d = '*{s}.npy'", ["side by side"]),
        ("d = '{s}{t}.npy'", ["side by side"]),
        ("d = '{1s}.npy'", ["{1s}", "no digit first"]),
        ("d = '{}.npy'", ["found {} in the pattern"]),
        ("d = '{s.npy'", ["lone {"]),
        ("d = '{d}.npy'", ["d is bound twice"]),
        ("d = '{s}.npy'\ns = ['1']", ["s is bound twice", "put s before d"]),
        ("d = '{s}.npy'\ne = 'raw/{d}x{e}.npy'", ["e is bound twice"]),
        ('d = "a\\u0000*"', ["no file found"]),
    ],
)
def test_pattern_that_cannot_be(loop, words):
    touch("1.npy")
    message = refusal(f"[for_each]\n{loop}", INPUT, "data = 'x.npy'\n[output]\nvolume = '{s}.nii'")
    assert message.startswith("study.toml: ")
    assert [word for word in words if word not in message] == []


# Names and paths


def test_one_config_is_what_denoise_makes_of_it(folder):
    texts = INPUT, "data = 'd.npy'\n[output]\nvolume = 'o.npy'\n[flow]\nbeta = 0.5\n[run]\nmemory = '2GiB'\nthreads = 1"
    (one,) = read_study([write("torus.toml", *texts)])
    assert (one.name, one.config) == ("torus", Path("torus.toml"))
    assert one.job == make_job(read_config(folder / "torus.toml"))
    assert (one.job.memory, one.job.settings.threads) == (2**31, 1)


def test_names_with_several_configs():
    plain = write("plain.toml", writing("p.npy"))
    loop = write("loop.toml", "[for_each]\ns = [1, 2]", writing("l{s}.npy"))
    assert names(read_study([loop, plain])) == ["loop: s=1", "loop: s=2", "plain"]
    others = [write(f"{f}/loop.toml", "[for_each]\ns = [1]", writing("o{s}.npy")) for f in ("a", "b")]
    assert names(read_study([plain, *others])) == [f"{Path.cwd().name}/plain", "a/loop: s=1", "b/loop: s=1"]
    twins = [plain, write("plain.conf", writing("q.npy"))]
    assert names(read_study(twins)) == ["plain.toml", "plain.conf"]
    assert read_study([]) == []


def test_paths_keep_their_meaning_behind_links(folder):
    write("far/configs/run.toml", INPUT, "data = '../d.npy'\n[output]\nvolume = '../o.npy'")
    (folder / "near").symlink_to(folder / "far" / "configs")
    touch("far/d.npy")
    (one,) = read_study([Path("near/run.toml")])
    assert one.job.data.is_absolute()
    assert one.job.data.samefile("far/d.npy")


# Checks over all jobs

TWO = "[for_each]\nn = [1, 2]"


@pytest.mark.parametrize(
    ("output", "file"),
    [
        ("volume = 'o.npy'", "o.npy"),
        ("volume = 'o{n}.npy'\nmesh = 'm.ply'", "m.ply"),
        ("volume = 'o{n}.npy'\nmesh = ['m.ply', 'm{n}.surf.gii', './a/../m.ply']", "m.ply"),
        ("volume = 'o{n}.npy'\nfilled = 'f.nii.gz'", "f.nii.gz"),
        ("volume = 'o{n}.npy'\non = 's.ply=v.func.gii'", "v.func.gii"),
        ("volume = '{n}/../1/o.npy'", "o.npy"),
    ],
)
def test_two_jobs_that_write_one_file(output, file):
    touch("1/x", "2/x", "a/x")
    message = refusal(TWO, INPUT, f"data = 'd{{n}}.npy'\n[output]\n{output}")
    assert message.startswith("study.toml: n=1 and n=2 both write ")
    assert file in message
    assert "{NAME}" in message


def test_outputs_beside_out_count_too():
    first = write("first.toml", writing("o.nii.gz"))
    for second, file in (
        (writing("o.npy"), r"o\.json"),
        (writing("o.func.gii"), r"o\.func\.gii"),  # where the values of the first one's mesh go
        (writing("o.shape.gii"), r"o\.surf\.gii"),
        (writing("p.npy", "mesh = 'o.surf.gii'"), r"o\.surf\.gii"),
        (writing("p.npy", "on = 's.ply=o.func.gii'"), r"o\.func\.gii"),
    ):
        with pytest.raises(RefusedError, match=rf"^second\.toml: first and second both write .*{file}"):
            read_study([first, write("second.toml", second)])
    other = write("second.toml", writing("p.npy"))
    assert names(read_study([first, other])) == ["first", "second"]
    Path("q.npy").symlink_to("p.npy")
    with pytest.raises(RefusedError, match="both write"):
        read_study([write("first.toml", writing("q.npy", "mesh = false")), other])


@pytest.mark.parametrize("line", ["data = '{d}'", "data = 'x.nii'\nweights = '{d}'", "data = 'x.nii'\nmask = '{d}'"])
def test_a_job_that_reads_what_another_writes(line):
    touch("a.nii.gz", "a_denoised.nii.gz")
    message = refusal("[for_each]\nd = '{n}.nii.gz'", INPUT, line, "[output]\nvolume = '{n}_denoised.nii.gz'")
    assert message.startswith("study.toml: n=a_denoised reads ")
    assert "a_denoised.nii.gz, which n=a writes" in message
    assert "narrow the pattern, or run two batches" in message


def test_a_job_that_would_replace_its_input():
    message = refusal(TWO, INPUT, "data = 'd{n}.npy'\n[output]\nvolume = './d{n}.npy'")
    assert message.startswith("study.toml: n=1: ")
    assert "d1.npy is an input and an output, and inputs are never changed" in message


def test_that_an_input_would_be_lost_is_said_before_that_two_jobs_write_it():
    message = refusal(TWO, INPUT, "data = 'd.npy'\n[output]\nvolume = 'd.npy'\n[time]\nseed = '{n}'")
    assert "d.npy is an input and an output" in message


def test_every_file_of_a_study_is_known():
    found = files_of(read_study([write("one.toml", writing("o.nii.gz", "on = 's.ply=v.func.gii'"))]))
    assert {Path(file).name for file in found} == {
        "one.toml", "psi.nii.gz", "d.npy", "s.ply", "o.nii.gz", "o.surf.gii", "o.func.gii", "v.func.gii", "o.json",
    }  # fmt: skip


def test_a_surface_that_another_job_writes():
    first = write("first.toml", writing("o.nii.gz"))
    second = write("second.toml", writing("p.nii.gz", "on = 'o.surf.gii=p.shape.gii'"))
    with pytest.raises(RefusedError, match=r"^second\.toml: second reads .*o\.surf\.gii, which first writes"):
        read_study([first, second])


def test_a_config_given_twice():
    path = write("a.toml", writing("o.npy"))
    with pytest.raises(RefusedError, match="given twice"):
        read_study([path, Path("../") / Path.cwd().name / "a.toml"])


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ((TWO, INPUT, "data='d'\n[output]\nvolume='{n}.npy'\n[band]\ndepth='{n}:1'"), "study.toml: n=2: depth: found"),
        ((TWO, INPUT, "data='{n}'\n[output]\nvolume='{n}.npy'"), "study.toml: n=1: [input] data: found 1; expected"),
        ((TWO, INPUT, "data='{n}.npy'"), "study.toml: n=1: [output] volume is missing; expected"),
        ((TWO, INPUT, "[output]\nvolume='{n}.npy'"), "study.toml: n=1: [input] data is missing; expected"),
        (("[input]\ndata='d'\n[output]\nvolume='o.npy'",), "study.toml: [input] levelset is missing; expected"),
        ((TWO, INPUT, "data='d'\n[output]\nvolume='{n}.png'"), "study.toml: n=1: "),
        ((TWO, INPUT, "data='d'\n[output]\nvolume='{n}.npy'\nmesh='{n}.xyz'"), "study.toml: n=1: "),
        ((INPUT, "data='d'\n[output]\nvolume='o.npy'\n[time]\nseed=-1"), "study.toml: seed: found -1"),
        ((INPUT, "date='d'"), "study.toml: unknown key 'date' in [input]; did you mean 'data'?"),
        (("[foreach]\nn = [1]",), "study.toml: unknown section [foreach]; did you mean 'for_each'?"),
        (("[for_each",), "study.toml: not a valid TOML"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_name_the_combination(texts, words):
    assert refusal(*texts).startswith(words)


def test_missing_config():
    with pytest.raises(RefusedError, match=r"nothing\.toml: cannot be read"):
        read_study([Path("nothing.toml")])


def test_values_at_vertices_and_flat_jobs_write_what_they_do():
    study(TWO, "[input]\nlevelset='lh.white'\ndata='lh.{n}'\n[output]\nvolume='lh.map{n}'\nfilled='lh.filled{n}'")
    study(TWO, "[input]\nlevelset='s.ply'\ndata='{n}.func.gii'\n[output]\nvolume='o{n}.shape.gii'")
    study(TWO, "[input]\ndata='{n}.nii'\n[output]\nvolume='o{n}.nii'\n[flow]\nflat=true")


# Parts


def test_parts_hold_every_job_once():
    planned = study(
        f"[for_each]\nn = {list(range(10))}", INPUT, "data = '{n}.npy'\n[output]\nvolume = 'o{n}.npy'\nmesh = false"
    )
    assert names(part(planned, "2/4")) == ["n=1", "n=5", "n=9"]
    assert part(planned, " 1 / 1 ") == planned
    assert sorted(names([each for k in range(1, 13) for each in part(planned, f"{k}/12")])) == sorted(names(planned))
    assert part(planned, "12/12") == []


@pytest.mark.parametrize("given", ["", "1", "0/3", "4/3", "1/0", "-1/3", "a/b", "1/2/3", "1.0/2", "/", "1/99999999999"])
def test_part_that_cannot_be(given):
    with pytest.raises(RefusedError, match="expected K/N"):
        part([], given)


def test_two_thousand_jobs_read_their_config_once(monkeypatch):
    import tomllib

    calls = []
    loads = tomllib.loads
    monkeypatch.setattr(tomllib, "loads", lambda text: calls.append(text) or loads(text))
    planned = study(
        f"[for_each]\nn = {list(range(1000))}\nhemi = ['lh', 'rh']",
        INPUT,
        "data = '{hemi}.{n}.npy'\n[output]\nvolume = 'o{hemi}{n}.npy'",
    )
    assert (len(planned), len(calls)) == (2000, 1)
