"""Decoder weights: formats read, exact padding, and what the messages say about files that can't be used."""

import pickle
import subprocess
import sys

import numpy as np
import pytest

from warpslam.errors import CheckpointError
from warpslam.field.decoder_files import DEFAULT_PATH, load_decoders
from warpslam.field.decoders import LEVELS, STATE_FORM, Decoders, expected_shapes, random_decoders
from warpslam.storage.state_file import write_state

torch = pytest.importorskip("torch")


def run_decoder(weights, points, features):
    """Forward pass written from the specification, float64, shapes (N, 3), (N, F) -> (N, outputs)."""
    t = {name: array.astype(np.float64) for name, array in weights.tensors.items()}
    entry = features if weights.level == "coarse" else np.sin(points @ t["embedder._B"])
    h = entry
    for k in range(5):
        h = np.maximum(h @ t[f"pts_linears.{k}.weight"].T + t[f"pts_linears.{k}.bias"], 0.0)
        if weights.level != "coarse":
            h = h + features @ t[f"fc_c.{k}.weight"].T + t[f"fc_c.{k}.bias"]
        if k == 2:
            h = np.concatenate([entry, h], axis=1)
    return h @ t["output_linear.weight"].T + t["output_linear.bias"]


def torch_state(decoders):
    """State dict of torch tensors."""
    return {name: torch.from_numpy(array.copy()) for name, array in decoders.state_dict().items()}


@pytest.fixture
def single(tmp_path):
    """A checkpoint of one state dict, and the decoders in it."""
    decoders = random_decoders(3)
    path = tmp_path / "decoders.pth"
    decoders.save(path)
    return path, decoders


@pytest.fixture
def authors_pair(tmp_path):
    """The authors' two files, with encoder weights and a NumPy scalar beside the decoders."""
    decoders = random_decoders(5)
    encoder = {"encoder.fc_pos.weight": torch.zeros(64, 3), "encoder.decoder_like.weight": torch.zeros(2)}
    coarse = {f"decoder.{name}": torch.from_numpy(a) for name, a in decoders.coarse.tensors.items()}
    torch.save({"model": {**encoder, **coarse}, "loss_val_best": np.float64(0.5), "it": 7}, tmp_path / "coarse.pt")
    pair = {f"decoder.coarse.{name}": torch.from_numpy(a) for name, a in decoders.middle.tensors.items()}
    pair |= {f"decoder.fine.{name}": torch.from_numpy(a) for name, a in decoders.fine.tensors.items()}
    torch.save({"model": {**encoder, **pair}, "epoch_it": 3}, tmp_path / "middle_fine.pt")
    return tmp_path, decoders


def assert_same(actual, expected, levels=LEVELS):
    """Every tensor of the levels is bitwise equal."""
    for level in levels:
        a, b = getattr(actual, level), getattr(expected, level)
        assert a.hidden == b.hidden and a.level == b.level == level
        assert set(a.tensors) == set(b.tensors)
        for name in b.tensors:
            assert a.tensors[name].dtype == np.float32
            np.testing.assert_array_equal(a.tensors[name], b.tensors[name], err_msg=f"{level} {name}")


def test_save_and_load_keep_every_bit(single):
    """What `save` writes, `load_decoders` reads back unchanged, in the reference's key names."""
    path, decoders = single
    assert_same(load_decoders(path), decoders)
    keys = torch.load(path, weights_only=True).keys()
    assert "middle_decoder.embedder._B" in keys and "coarse_decoder.pts_linears.3.weight" in keys


@pytest.mark.parametrize("key", ["model", "decoder_state_dict", "something_else"])
def test_nested_state_dict(tmp_path, key):
    """The state dict may sit under a top-level key, beside other entries."""
    decoders = random_decoders(1)
    torch.save({"iteration": 4, "grid": {"a": torch.zeros(2)}, key: torch_state(decoders)}, tmp_path / "c.pth")
    assert_same(load_decoders(tmp_path / "c.pth"), decoders)


def test_half_precision_becomes_float32(tmp_path):
    """Weights stored in another float type are converted."""
    state = {name: tensor.half() for name, tensor in torch_state(random_decoders(1)).items()}
    torch.save(state, tmp_path / "half.pth")
    loaded = load_decoders(tmp_path / "half.pth")
    assert all(array.dtype == np.float32 for array in loaded.state_dict().values())


def test_authors_pair(authors_pair):
    """coarse.pt and middle_fine.pt: their "coarse" of the second file is the middle level; colour is random."""
    folder, decoders = authors_pair
    loaded = load_decoders(coarse=folder / "coarse.pt", middle_fine=folder / "middle_fine.pt", color_seed=9)
    assert_same(loaded, decoders, ("coarse", "middle", "fine"))
    assert_same(loaded, random_decoders(9), ("color",))
    assert_same(load_decoders(folder, color_seed=9), loaded)


def test_half_a_pair_is_refused(authors_pair):
    """One file of the pair, or a folder that lacks one, is an error that names what is missing."""
    folder, _ = authors_pair
    with pytest.raises(CheckpointError, match="middle_fine"):
        load_decoders(coarse=folder / "coarse.pt")
    (folder / "middle_fine.pt").unlink()
    with pytest.raises(CheckpointError, match=r"middle_fine\.pt: there is no such file"):
        load_decoders(folder)


def test_third_party_file(data_dir):
    """A real 20-wide state dict saved on a CUDA device loads on the CPU."""
    loaded = load_decoders(data_dir / "decoders" / "slim_nice_h20.pth")
    assert [w.hidden for w in loaded] == [20] * 4
    assert loaded.fine.tensors["fc_c.0.weight"].shape == (20, 64)
    assert loaded.color.tensors["output_linear.weight"].shape == (4, 20)


@pytest.mark.parametrize("level", LEVELS)
def test_padding_is_exact(level):
    """A padded decoder computes the same outputs, also through the skip connection."""
    narrow = getattr(random_decoders(2, hidden=20), level)
    rng = np.random.default_rng(0)
    for name, array in narrow.tensors.items():
        if name.endswith("bias"):
            array += rng.normal(0, 0.3, array.shape).astype(np.float32)
    wide = narrow.padded()
    assert {n: a.shape for n, a in wide.tensors.items()} == expected_shapes(level, 32)
    points = rng.normal(0, 2, (200, 3))
    features = rng.normal(0, 1, (200, 64 if level == "fine" else 32))
    np.testing.assert_allclose(
        run_decoder(wide, points, features), run_decoder(narrow, points, features), rtol=0, atol=1e-12
    )


def test_padding_cannot_shrink():
    """Padding to less than the present width is refused."""
    with pytest.raises(CheckpointError, match="can't be padded to 16"):
        random_decoders(0, hidden=20).padded(16)


def test_random_decoders_follow_the_reference_initialisation():
    """Seeded, different for each seed, and distributed as stated."""
    a, b = random_decoders(7), random_decoders(7)
    assert_same(a, b)
    assert not np.array_equal(a.middle.tensors["embedder._B"], random_decoders(8).middle.tensors["embedder._B"])
    assert not np.array_equal(a.middle.tensors["embedder._B"], a.fine.tensors["embedder._B"])
    assert 20 < a.middle.tensors["embedder._B"].std() < 30
    limit = np.sqrt(2.0) * np.sqrt(6.0 / (32 + 125))
    weights = np.abs(a.fine.tensors["pts_linears.3.weight"])
    assert 0.98 * limit < weights.max() <= limit
    assert not a.fine.tensors["pts_linears.3.bias"].any()
    assert 0 < np.abs(a.fine.tensors["fc_c.0.bias"]).max() <= 1 / 8


def _drop(state):
    del state["fine_decoder.fc_c.2.bias"]


def _reshape(state):
    state["middle_decoder.pts_linears.3.weight"] = torch.zeros(32, 93)


def _poison(state):
    state["color_decoder.output_linear.weight"][0, 0] = float("nan")


def _no_color(state):
    for key in [key for key in state if key.startswith("color")]:
        del state[key]


def _too_wide(state):
    state["coarse_decoder.pts_linears.0.bias"] = torch.zeros(64)


def _extra_block(state):
    state["coarse_decoder.pts_linears.5.weight"] = torch.zeros(32, 32)


def _not_a_tensor(state):
    state["coarse_decoder.output_linear.bias"] = 1.0


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (_drop, ["fine_decoder.fc_c.2.bias", "missing", "(32,)"]),
        (_reshape, ["middle_decoder.pts_linears.3.weight", "(32, 93)", "(32, 125)"]),
        (_poison, ["color_decoder.output_linear.weight", "NaN", "1 of 128"]),
        (_no_color, ["color decoder is missing", "color_decoder."]),
        (_too_wide, ["coarse_decoder.pts_linears.0.bias", "(64,)", "32"]),
        (_extra_block, ["unexpected key", "coarse_decoder.pts_linears.5.weight"]),
        (_not_a_tensor, ["coarse_decoder.output_linear.bias", "float", "(1,)"]),
    ],
)
def test_damaged_state_dict(tmp_path, damage, parts):
    """Each fault names the file, the key, and found and expected shape."""
    state = torch_state(random_decoders(0))
    damage(state)
    path = tmp_path / "damaged.pth"
    torch.save(state, path)
    with pytest.raises(CheckpointError) as caught:
        load_decoders(path)
    for part in (str(path), *parts):
        assert part in str(caught.value)


class Payload:
    """Writes a file when unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (self.path, "w"))


def test_files_that_are_no_checkpoint(tmp_path, single):
    """Missing, empty, garbage, truncated and foreign files are errors with the path and a remedy."""
    data = single[0].read_bytes()
    contents = {
        "empty.pth": b"",
        "garbage.pth": bytes(range(256)) * 8,
        "text.pth": b"version https://git-lfs.github.com/spec/v1\n",
        "truncated.pth": data[: len(data) // 2],
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CheckpointError, match="not a torch checkpoint|is empty") as caught:
            load_decoders(tmp_path / name)
        assert name in str(caught.value) and "again" in str(caught.value)
    with pytest.raises(CheckpointError, match="no such file"):
        load_decoders(tmp_path / "absent.pth")
    torch.save([torch.zeros(2)], tmp_path / "list.pth")
    with pytest.raises(CheckpointError, match="holds a list"):
        load_decoders(tmp_path / "list.pth")
    torch.save({"conv.weight": torch.zeros(2)}, tmp_path / "foreign.pth")
    with pytest.raises(CheckpointError, match="conv.weight"):
        load_decoders(tmp_path / "foreign.pth")


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    """A pickle that would run code is refused and leaves no trace."""
    trace = tmp_path / "trace.txt"
    (tmp_path / "raw.pth").write_bytes(pickle.dumps(Payload(str(trace))))
    torch.save({"model": Payload(str(trace))}, tmp_path / "zip.pth")
    for name in ("raw.pth", "zip.pth"):
        with pytest.raises(CheckpointError, match=name):
            load_decoders(tmp_path / name)
        assert not trace.exists()


def test_default_weights_are_small_and_complete():
    """The packaged file is below 1 MB, and as wide as the paper's decoders."""
    assert DEFAULT_PATH.stat().st_size < 1_000_000
    decoders = load_decoders()
    assert isinstance(decoders, Decoders)
    assert [w.hidden for w in decoders] == [32] * 4


def test_state_file(tmp_path):
    """It holds the same numbers as a checkpoint, and any other bit is noticed."""
    decoders, path = random_decoders(3, hidden=20), tmp_path / "decoders.safetensors"
    decoders.save(path)
    assert_same(load_decoders(path), decoders)
    whole = path.read_bytes()
    for place in range(40, len(whole), len(whole) // 40):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with pytest.raises(CheckpointError, match="decoders.safetensors"):
            load_decoders(path)


def test_package_weights_need_no_torch():
    """Importing it takes seconds and much memory."""
    code = "import sys; from warpslam.field.decoder_files import load_decoders as f; f(); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_state_file_of_another_shape(tmp_path):
    """The key and what is expected of it."""
    state = random_decoders(3).state_dict()
    state["fine_decoder.fc_c.0.weight"] = np.zeros((32, 7), np.float32)
    write_state(tmp_path / "d.safetensors", STATE_FORM, {}, state)
    with pytest.raises(CheckpointError, match="fine_decoder.fc_c.0.weight"):
        load_decoders(tmp_path / "d.safetensors")
