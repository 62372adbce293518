"""The command line: arguments, what is printed, exit codes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time

import numpy as np
import pytest
from trimesh.proximity import closest_point_naive

from tests.fakes import FakeSequence, FakeSlam, Terminal, wall
from warpslam import __version__, cli
from warpslam.cli import progress
from warpslam.cli.common import parse_frames
from warpslam.errors import ConfigError, DatasetError
from warpslam.field.decoders import random_decoders
from warpslam.pipeline import finished as revisit
from warpslam.pipeline import run as pipeline
from warpslam.storage.json_files import read_json
from warpslam.storage.tum import read_tum
from warpslam.synthetic import demo


@pytest.fixture
def faked(monkeypatch: pytest.MonkeyPatch) -> type[FakeSlam]:
    """Sequences and SLAM that answer at once, behind the real command line; plots and reports are left out."""

    class Slam(FakeSlam):
        configs: list = []

    def build(intrinsics, config, device, seed, method, timing):
        Slam.configs.append(config)
        return Slam(intrinsics, config=config, device=device, seed=seed)

    monkeypatch.setattr(pipeline, "build_slam", build)
    monkeypatch.setattr(pipeline, "draw_plots", lambda *arguments: None)
    monkeypatch.setattr(pipeline, "draw_panels", lambda *arguments: None)
    monkeypatch.setattr(pipeline, "write_report", lambda folder: None)
    monkeypatch.setattr(revisit, "load_slam", lambda folder, device=None: Slam.load(folder.map, device))
    for module in (pipeline, revisit):
        monkeypatch.setattr(module, "open_source", lambda source: FakeSequence(8, unreadable=(6,)))
    return Slam


def test_run_prints_progress_and_summary(faked, tmp_path, capsys):
    """Plain lines where there is no terminal, then the figures and where everything lies; warnings on stderr."""
    assert cli.main(["run", "seq", "--frames", "0:7", "--seed", "5", "-o", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert "frame 1/7" in out and "frame 7/7" not in out  # frame 6 can't be read
    metrics = read_json(tmp_path / "out" / "metrics.json")
    errors = [f"{100 * metrics['ate_m'][how]['rmse']:.2f} cm {how}" for how in ("aligned", "unaligned")]
    assert f"ATE RMSE    {', '.join(errors)}" in out and "6 of 7 (6 OK, 1 unreadable), finished" in out
    assert f"written to  {tmp_path / 'out'}" in out
    assert "WARNING: frame 6 left out" in err
    assert metrics["seed"] == 5


def test_run_passes_settings_on(faked, tmp_path):
    """Preset, overrides and the decoder file reach the configuration that is used and written."""
    arguments = ["run", "seq", "--preset", "paper_scannet", "--set", "mapping.window=3", "tracking.iterations=7"]
    arguments += ["--set", "mapping.every=2", "--decoders", "some.pth", "-o", str(tmp_path)]
    assert cli.main(arguments) == 0
    config = faked.configs[-1]
    assert (config.mapping.window, config.tracking.iterations, config.mapping.every) == (3, 7, 2)
    assert (config.tracking.pixels, config.decoders) == (1000, "some.pth")
    assert "decoders: some.pth" in (tmp_path / "config.yaml").read_text()


@pytest.mark.parametrize("command", [["run", "seq"], ["batch", "seq"]])
def test_settings_from_a_file(faked, tmp_path, capsys, command):
    """A file that can't be used is named with its field; it takes the place of a preset, a map and a checkpoint."""
    file, out = tmp_path / "c.yaml", ["-o", str(tmp_path / "out")]
    for text, message in (
        ("mapping: {window: 0}", "c.yaml: mapping.window"),
        ("mapping: {windw: 3}", "c.yaml: no setting mapping.windw; did you mean mapping.window?"),
        ("[]", "c.yaml: expected a mapping"),
        ("a: b: c", "c.yaml: can't be read as yaml"),
    ):
        file.write_text(text)
        assert cli.main([*command, "--config", str(file), *out]) == 2
        assert message in capsys.readouterr().err
    assert cli.main([*command, "--config", str(tmp_path / "none.yaml"), *out]) == 2
    assert "none.yaml: can't be read" in capsys.readouterr().err
    assert cli.main([*command, "--config", str(file), "--preset", "replica", *out]) == 2
    assert "--config does not go with --preset" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    if command[0] == "run":
        assert cli.main([*command, "--config", str(file), "--map", "m", *out]) == 2
        assert cli.main(["run", "--resume", str(tmp_path), "--config", str(file)]) == 2
        assert "--config does not go with --resume" in capsys.readouterr().err


def test_run_records_how_to_open_the_input_again(faked, tmp_path):
    """The folder is kept as an absolute path, with the format and camera given."""
    cli.main(["run", "seq", "--dataset", "icl", "--camera", "1,1,1,1,2,2,1000", "-o", str(tmp_path)])
    source = read_json(tmp_path / "input.json")
    assert source["path"].startswith("/") and source["path"].endswith("seq")
    assert (source["dataset"], source["camera"]) == ("icl", "1,1,1,1,2,2,1000")
    assert source["command"] == f"warpslam run seq --dataset icl --camera 1,1,1,1,2,2,1000 -o {tmp_path}"


def test_report_of_one_run_and_of_several(faked, tmp_path, monkeypatch, capsys):
    """One run: its report, in its folder or where it is told to. Several: a comparison."""
    for name in ("a", "b"):
        cli.main(["run", "seq", "--frames", "0:3", "-o", str(tmp_path / name)])
    monkeypatch.setattr("warpslam.report.pictures.SUPERSAMPLING", 1)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    for arguments in (["a"], ["a", "-o", "other.html"], ["a", "b"]):
        assert cli.main(["report", *arguments]) == 0
    assert capsys.readouterr().out.split() == ["a/report.html", "other.html", "comparison.html"]
    assert "<h1>2 runs</h1>" in (tmp_path / "comparison.html").read_text()
    beside, elsewhere = (tmp_path / name for name in ("a/report.html", "other.html"))
    assert re.sub('href="a/', 'href="', elsewhere.read_text()) == beside.read_text()
    assert cli.main(["report", "a", "nowhere"]) == 2


def test_method_and_poses_are_passed_on(faked, tmp_path, capsys, monkeypatch):
    """--method reaches the run; --poses gives an earlier run's trajectory, which is then not tracked again."""
    assert cli.main(["run", "seq", "--frames", "0:4", "-o", str(tmp_path / "a")]) == 0
    assert not faked.configs[-1].tracking.use_given_poses
    assert "map         2.50 MB, 102,598 FLOP a point" in capsys.readouterr().out
    poses = str(tmp_path / "a" / "trajectory.tum")
    assert cli.main(["run", "seq", "--frames", "0:4", "--poses", poses, "-o", str(tmp_path / "b")]) == 0
    assert faked.configs[-1].tracking.use_given_poses
    assert read_json(tmp_path / "b" / "metrics.json")["poses"] == poses
    methods = []

    def build(intrinsics, config, device, seed, method, timing):
        methods.append(method)
        return faked(intrinsics, config=config)

    monkeypatch.setattr(pipeline, "build_slam", build)
    assert cli.main(["run", "seq", "--method", "tsdf", "--frames", "0:4", "-o", str(tmp_path / "c")]) == 0
    assert methods == ["tsdf"] and read_json(tmp_path / "c" / "metrics.json")["method"] == "tsdf"


def test_interrupted_run_exits_130_with_partial_results(faked, tmp_path, monkeypatch):
    """Ctrl-C ends in the usual exit code and a run folder that can be used."""
    monkeypatch.setattr(faked, "interrupt_at", 3)
    assert cli.main(["run", "seq", "-o", str(tmp_path)]) == 130
    assert len(read_tum(tmp_path / "trajectory.tum")[0]) == 3
    assert cli.main(["eval", str(tmp_path)]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "/no/such/folder"], "/no/such/folder"),
        (["eval", "/no/such/run"], "/no/such/run"),
        (["render", "/no/such/run", "--frame", "0"], "/no/such/run"),
        (["mesh", "/no/such/run"], "/no/such/run"),
        (["report", "/no/such/run"], "/no/such/run"),
        (["demo", "--set", "mapping.windw=3"], "mapping.windw"),
        (["demo", "--set", "mapping"], "mapping"),
        (["demo", "--device", "cuda:77"], "cuda:77"),
        (["profile", "demo", "--frames", "0:2", "--device", "cuda:77"], "cuda:77"),
        (["profile", "demo", "--json", "/no/such/folder/p.json"], "/no/such/folder"),
        (["render-room", "sheet", "--seeds", "0", "-o", "/no/such/folder/p.png"], "/no/such/folder/p.png"),
    ],
)
def test_errors_are_one_line_and_exit_2(arguments, message, tmp_path, capsys):
    """What the user can put right is one clear line on stderr, without a traceback; only what goes on may be said
    before it, where the machine is slow.
    """
    extra = ["-o", str(tmp_path)] if arguments[0] == "demo" else []
    assert cli.main([*arguments, *extra]) == 2
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if not line.endswith(" ...")]
    assert len(lines) == 1 and lines[0].startswith("warpslam: ") and message in lines[0]


def test_debug_shows_the_traceback():
    """With --debug the exception comes through."""
    with pytest.raises(DatasetError):
        cli.main(["eval", "/no/such/run", "--debug"])


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["run"], ["run", "x", "--frames", "5"], ["run", "x", "--frames", "a:b"], ["render", "x"]]
)
def test_wrong_arguments_exit_2(arguments, capsys):
    """A command line that can't be parsed prints its usage."""
    with pytest.raises(SystemExit) as exit_:
        cli.main(arguments)
    assert exit_.value.code == 2
    assert ("there is no command" if arguments == ["fly"] else "usage:") in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0:200", slice(0, 200)), ("::2", slice(None, None, 2)), ("5:", slice(5, None)), (":-1:3", slice(None, -1, 3))],
)
def test_frames_are_a_python_slice(text, expected):
    """A:B:STEP with any part left out."""
    assert parse_frames(text) == expected


def test_eval_prints_figures(faked, tmp_path, capsys):
    """RMSE aligned and unaligned in cm, RPE, and how many frames were compared; --json gives the same as JSON."""
    run = str(tmp_path / "run")
    cli.main(["run", "seq", "-o", run])
    capsys.readouterr()
    assert cli.main(["eval", run]) == 0
    out = capsys.readouterr().out
    rmse = 100 * read_json(tmp_path / "run" / "metrics.json")["ate_m"]["unaligned"]["rmse"]
    assert f"ATE unaligned    RMSE {rmse:.3f} cm" in out and "7 of 7 compared" in out
    assert cli.main(["eval", run, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ate_m"]["unaligned"]["rmse"] == pytest.approx(rmse / 100, abs=5e-9)


def test_eval_compares_the_mesh(faked, small_evaluation, tmp_path, capsys):
    """With a true surface a table names the protocol; --protocol all has a line for each, --views the renderings."""
    run = str(tmp_path / "run")
    cli.main(["run", "seq", "-o", run, "--frames", "0:3"])
    wall().export(tmp_path / "wall.ply")
    capsys.readouterr()
    assert cli.main(["eval", run, "--truth-mesh", str(tmp_path / "wall.ply"), "--views", "1"]) == 0
    out = capsys.readouterr().out
    (line,) = (line for line in out.splitlines() if line.startswith("frustum"))
    assert line.split()[0] == "frustum+occlusion" and "100.00 %" in line
    assert "SSIM" in out and "1 frames" in out
    assert cli.main(["eval", run, "--gt-mesh", str(tmp_path / "wall.ply"), "--protocol", "all"]) == 0
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.startswith("frustum")]
    assert names == ["frustum+occlusion", "frustum", "frustum+occlusion+virtual"]
    assert cli.main(["eval", run, "--gt-mesh", str(tmp_path / "wall.ply"), "--protocol", "visible"]) == 2
    assert "choose one of frustum," in capsys.readouterr().err


def test_render_and_mesh_of_a_run(faked, tmp_path, capsys):
    """Both write where they are told to and say so."""
    run = str(tmp_path / "run")
    cli.main(["run", "seq", "-o", run])
    assert cli.main(["render", run, "--frame", "2", "-o", str(tmp_path / "two.png")]) == 0
    assert cli.main(["mesh", run, "--voxel", "0.05", "-o", str(tmp_path / "m.ply")]) == 0
    assert (tmp_path / "two.png").stat().st_size > 1000
    assert f"{tmp_path / 'm.ply'}: 4 vertices, 2 faces\n" in capsys.readouterr().out
    assert cli.main(["mesh", run, "--forecast", "--refine"]) == 0
    out = capsys.readouterr().out
    assert f"{tmp_path / 'run' / 'mesh_forecast.ply'}: 4 vertices, 2 faces, 1 of them forecast" in out


def test_demo_runs_on_its_own_sequence(faked, small_evaluation, tmp_path, monkeypatch, capsys):
    """The demo needs no data, prints ATE and surface accuracy, and its settings can be overridden."""

    class Demo(FakeSequence):
        name, mesh = "demo", wall()

    monkeypatch.setattr(pipeline, "open_source", lambda source: Demo(4) if source.is_demo else None)
    assert cli.main(["demo", "--set", "mapping.window=4", "-o", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "ATE RMSE" in out and "frustum+occlusion" in out
    assert faked.configs[-1].mapping.window == 4
    assert read_json(tmp_path / "input.json")["path"] is None


def test_demo_sequence_is_small_and_exact():
    """The embedded sequence has depth, truth and a surface that agree: depth points lie on the mesh."""
    sequence = demo.demo_sequence()
    frame = sequence[demo.FRAME_COUNT // 2]
    assert len(sequence) == demo.FRAME_COUNT and frame.depth.shape == (demo.INTRINSICS.height, demo.INTRINSICS.width)
    v, u = np.nonzero(frame.depth)
    keep = slice(None, None, max(1, len(u) // 20))
    z, k = frame.depth[v, u][keep].astype(float), sequence.intrinsics
    points = np.stack([(u[keep] - k.cx) / k.fx * z, (v[keep] - k.cy) / k.fy * z, z, np.ones_like(z)])
    world = (frame.T_world_camera @ points)[:3].T
    assert closest_point_naive(sequence.mesh, world)[1].max() < 0.01


def test_info_names_versions_devices_and_decoders(capsys, tmp_path):
    """One screen that a bug report needs, with the decoder file that is asked about."""
    random_decoders().save(tmp_path / "d.pth")
    assert cli.main(["info", "--decoders", str(tmp_path / "d.pth")]) == 0
    out = capsys.readouterr().out
    words = ["warpslam", "warp-lang", "torch", "cpu", "d.pth", "hidden width 32", "replica", "tum_rgbd"]
    words += ["40,961", "443,908"]
    for word in words:
        assert word in out, word


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_each_command_explains_itself(command, capsys):
    """``--help`` of a command says what ``warpslam --help`` says of it, and names its options."""
    with pytest.raises(SystemExit) as exit_:
        cli.main([command, "--help"])
    assert exit_.value.code == 0
    out = " ".join(capsys.readouterr().out.split())
    text = cli.COMMANDS[command][1]
    assert text[0].upper() + text[1:] + "." in out and "options: -h, --help" in out
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert f"{command} {text}" in " ".join(capsys.readouterr().out.split())


def test_only_the_command_asked_for_is_imported():
    """``--help`` and ``--version`` load no command and no NumPy; ``check`` loads itself, and neither torch nor Warp."""
    code = (
        "import sys, contextlib\n"
        "from warpslam import cli\n"
        "with contextlib.suppress(SystemExit): cli.main(sys.argv[1:])\n"
        "print(*sys.modules, file=sys.stderr)"
    )

    def loaded(*arguments: str) -> set[str]:
        done = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
        return set(done.stderr.split())

    for arguments in (["--help"], ["--version"]):
        modules = loaded(*arguments)
        assert not {f"warpslam.cli.{module}" for module, _ in cli.COMMANDS.values()} & modules
        assert "warpslam.cli" in modules and not {"numpy", "torch", "warp"} & modules
    modules = loaded("check", "--help")
    assert "warpslam.cli.check" in modules and not {"warpslam.cli.run", "torch", "warp"} & modules


@pytest.mark.parametrize("command", [*cli.COMMANDS, "render-room sequence", "render-room sheet"])
def test_shared_options_read_alike(command, capsys):
    """What several commands take has one wording, and every command can show the traceback of an error."""
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "--debug" in out or command == "render-room"
    wording = {
        "--device DEVICE": "cpu, cuda:0, ... (default: a GPU if there is one)",
        "--dataset DATASET": "format of the folder (default: told from its file names)",
        "--camera FX,FY,CX,CY,WIDTH,HEIGHT,DEPTH_SCALE": "camera, not the dataset's",
    }
    for option, text in wording.items():
        if option in out and command != "warmup":  # which takes architectures, too
            assert f"{option} {text}" in out


def test_version(capsys):
    """The version is that of the package."""
    with pytest.raises(SystemExit) as exit_:
        cli.main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out.strip() == f"warpslam {__version__}"


def test_progress_bar_on_a_terminal(monkeypatch, faked, tmp_path):
    """On a terminal the rich bar is fed with the same figures and ends at the total."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "160")
    assert cli.main(["run", "seq", "--frames", "0:6", "-o", str(tmp_path)]) == 0
    text = terminal.getvalue()
    assert "fake sequence" in text and "6/6" in text and "ATE 0." in text and "fps" in text


def test_progress_in_80_columns(monkeypatch, faked, tmp_path):
    """Name, bar, count, figures and the time left stand in one line of 80 columns, also for a long name."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setattr(FakeSequence, "name", "a sequence with a name that fills a line by itself")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main(["run", "seq", "--frames", "0:6", "-o", str(tmp_path)]) == 0
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line) for line in re.split(r"[\r\n]", terminal.getvalue())]
    whole = [line for line in lines if "6/6" in line and line.startswith("a sequence wi")]
    assert whole and all(len(line) <= 80 for line in whole)
    assert any("fps" in line and "ATE 0." in line and line.rstrip().endswith("left") for line in whole)
    assert any("writing the report" in line for line in whole)


def test_stages_after_the_last_frame(faked, tmp_path, capsys):
    """Where there is no terminal each of them is a line, in their order, after the last frame."""
    assert cli.main(["run", "seq", "--frames", "0:6", "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    stages = ["frame 6/6", "refining the map", "saving", "extracting the mesh", "rendering pictures", "writing the rep"]
    places = [out.index(stage) for stage in stages]
    assert places == sorted(places)


def test_long_work_is_shown(capsys, monkeypatch):
    """What takes its time says so, with how far it is and how long it will take; what does not, says nothing."""
    monkeypatch.setattr(progress, "_QUIET_SECONDS", 0.05)
    with progress.working("rendering") as advance:
        time.sleep(0.3)
        advance(1, 4)
    with progress.working("reading") as advance:
        advance(1, 4)
    shown = capsys.readouterr().err
    assert (
        "rendering ..." in shown and re.search(r"rendering 1/4, [\d.]+ (s|ms) left", shown) and "reading" not in shown
    )


def test_set_does_not_swallow_the_folder(capsys):
    """A word that is no KEY=VALUE is named, and where the folder goes."""
    with pytest.raises(SystemExit):
        cli.main(["run", "--set", "mapping.every=2", "scans/kitchen"])
    assert "--set scans/kitchen: is no KEY=VALUE; if it is the folder, name it before --set" in capsys.readouterr().err


def test_a_gpu_that_is_not_there(tmp_path, capsys, monkeypatch):
    """Is told without a traceback, and before anything is written."""
    from warpslam.pipeline import setup

    monkeypatch.setattr(setup.wp, "get_devices", lambda: ["cpu"])
    with pytest.raises(ConfigError, match="device 'cuda' is not there; this machine has cpu"):
        setup.check_device("cuda")
