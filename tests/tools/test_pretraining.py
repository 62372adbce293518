"""Pretraining of the decoders: networks against the reference, samples, small maps, resuming, the commands."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tools.decoders import pretrain
from tools.decoders.evaluation import fit_room, free_space_feature
from tools.decoders.mapping import RayPool, random_placement, ray_weights, sample_distances, stage_of
from tools.decoders.networks import DecoderSet, Lattice, LevelDecoder, PointEncoder, interpolate
from tools.decoders.quiet import quiet_fine_decoder
from tools.decoders.room_samples import HELD_OUT_SEED, SampleSizes, make_samples, march
from tools.decoders.training import Trainer, TrainingConfig
from warpslam.errors import CheckpointError
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import LEVELS, random_decoders
from warpslam.synthetic import make_room

SIZES = SampleSizes(surface=3000, points=12000, cameras=4, rays=80)
SMALL = TrainingConfig(
    crop_count=1,
    cloud_size=200,
    point_count=200,
    scene_count=2,
    ray_count=20,
    label_count=100,
    longest_mapping=10,
    crop_size=1.28,
)


class BoxRoom:
    """A 4 x 3 x 2.5 m room with walls 0.3 m thick and one block on the floor."""

    bounds = np.array([[-0.3, -0.3, -0.3], [4.3, 3.3, 2.8]])

    def occupancy(self, points):
        """In a wall or in the block."""
        block = ((points > [2.0, 1.0, 0.0]) & (points < [2.5, 1.6, 0.7])).all(axis=1)
        return ~((points > 0) & (points < [4.0, 3.0, 2.5])).all(axis=1) | block

    def sample_surface(self, count, rng):
        """Points of the six walls, with inward normals; colour tells the axis."""
        axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
        size = np.array([4.0, 3.0, 2.5])
        points = rng.uniform(0, 1, (count, 3)) * size
        points[np.arange(count), axis] = side * size[axis]
        normals = np.zeros((count, 3))
        normals[np.arange(count), axis] = 1 - 2 * side
        return points, normals, np.eye(3)[axis] * 0.8 + 0.1


@pytest.fixture(scope="module")
def room():
    """Samples of the box room."""
    return make_samples(BoxRoom(), 0, SIZES)


@pytest.fixture(autouse=True)
def one_thread():
    """The networks here are too small for more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_decoders_and_compositing_match_the_reference(golden, tmp_path):
    """Middle logits and ray weights of the authors' code are reproduced."""
    state = {key[4:]: torch.from_numpy(golden[key]) for key in golden.files if key.startswith("dec/")}
    torch.save(state, tmp_path / "golden.pth")
    decoder = LevelDecoder(load_decoders(tmp_path / "golden.pth").middle)
    points, bound = golden["pts"], golden["bound"]
    inside = ((points > bound[:, 0]) & (points < bound[:, 1])).all(axis=1)
    with torch.no_grad():
        logits = decoder(torch.tensor(points).float(), torch.tensor(golden["feat_middle"]).float()).numpy()
    expected = golden["query/middle"][:, 3]
    np.testing.assert_allclose(logits[inside], expected[inside], atol=2e-5 * np.abs(expected[inside]).max())
    weights = ray_weights(torch.tensor(golden["render/fine/raw"][..., 3]).double()).numpy()
    np.testing.assert_allclose(weights, golden["render/fine/w"], atol=1e-5)


def test_weights_survive_the_torch_form():
    """NumPy -> module -> NumPy changes nothing, at any width."""
    before = random_decoders(4, hidden=20)
    after = DecoderSet(before).weights()
    for name, array in before.state_dict().items():
        np.testing.assert_array_equal(after.state_dict()[name], array)


def test_residual_stops_the_middle_gradient():
    """The middle feature enters the fine decoder as a constant; the fine feature gets its gradient."""
    decoders = DecoderSet(random_decoders(0))
    fine, middle = torch.randn(5, 32, requires_grad=True), torch.randn(5, 32, requires_grad=True)
    decoders.residual(torch.randn(5, 3), fine, middle).sum().backward()
    assert middle.grad is None and fine.grad.abs().max() > 0


def test_lattice_is_world_aligned_and_trilinear():
    """Vertices lie at multiples of the spacing; a linear function is interpolated exactly, in each scene by itself."""
    rng = np.random.default_rng(0)
    lower = torch.tensor([[-1.03, 2.0, 0.5], [3.3, -4.0, 0.1]])
    lattice = Lattice.covering(lower, lower + 1.5, 0.32)
    scene = torch.tensor(rng.integers(0, 2, 300))
    points = lower[scene] + torch.tensor(rng.uniform(0, 1.5, (300, 3)), dtype=torch.float32)
    grid = torch.stack(torch.meshgrid(*[torch.arange(n) for n in lattice.shape], indexing="ij"), dim=-1).view(-1, 3)
    table = torch.zeros(lattice.row_count, 32)
    slope = torch.tensor([[1.0, -2.0, 0.5], [0.3, 0.7, -1.1]])
    for s in range(2):
        index = lattice.first[s] + grid
        rows = lattice.rows(index, torch.full((len(index),), s))
        table[rows] = ((index * 0.32) @ slope[s])[:, None]
    expected = (points * slope[scene]).sum(dim=1)
    actual = interpolate(table, lattice.stencil(points, scene))
    torch.testing.assert_close(actual, expected[:, None].expand(-1, 32), atol=2e-5, rtol=0)


def test_encoder_moves_with_the_lattice():
    """Shifting points and lattice by whole cells gives the same features: no absolute position is learnt."""
    torch.manual_seed(0)
    encoder = PointEncoder(0.32, depth=1)
    points, scene = torch.rand(200, 3), torch.zeros(200, dtype=torch.long)
    normals, colors = torch.randn(200, 3), torch.rand(200, 3)
    tables = []
    for shift in (0.0, 12 * 0.32):
        lattice = Lattice.covering(torch.full((1, 3), shift + 1e-3), torch.full((1, 3), shift + 1.0), 0.32)
        tables.append(encoder(points + shift, normals, colors, scene, lattice))
    assert tables[0].abs().max() > 0
    torch.testing.assert_close(tables[0], tables[1], atol=1e-4, rtol=0)


def test_compositing_by_hand():
    """An opaque sample behind a transparent one takes all the weight; halves share it 1/2, 1/4, 1/8."""
    weights = ray_weights(torch.tensor([[-10.0, 10.0, 10.0], [0.0, 0.0, 0.0]]))
    torch.testing.assert_close(weights, torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.25, 0.125]]), atol=1e-6, rtol=0)


def test_samples_along_a_ray():
    """48 sorted samples from 1 % of the depth to 1.2 x the largest one; a third of them within 5 %."""
    z = sample_distances(torch.tensor([1.0, 4.0]), torch.Generator().manual_seed(0))
    assert z.shape == (2, 48) and (z.diff(dim=1) >= 0).all()
    assert ((z[:, 0] >= torch.tensor([0.01, 0.04])) & (z[:, 0] < 0.2)).all()
    assert ((z[:, -1] > 4.6) & (z[:, -1] <= 4.8)).all()
    assert ((z[0] > 0.949) & (z[0] < 1.051)).sum() >= 16
    assert not torch.equal(z, sample_distances(torch.tensor([1.0, 4.0]), torch.Generator().manual_seed(1)))


def test_stages_follow_the_reference():
    """60 iterations are 25 middle, 12 fine and 23 colour."""
    stages = [stage_of(i, 60) for i in range(60)]
    assert [stages.count(s) for s in ("middle", "fine", "color")] == [25, 12, 23]


def test_placement_is_rigid_and_varied():
    """Rotations are proper, some tilt the room, and the shift reaches metres."""
    rng = np.random.default_rng(0)
    placements = [random_placement(rng) for _ in range(200)]
    for rotation, _ in placements:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0.99
    tilted = sum(rotation[2, 2] < 0.999 for rotation, _ in placements)
    assert 70 < tilted < 130 and np.abs([shift for _, shift in placements]).max() > 4


def test_march_finds_the_first_surface():
    """Distances to a wall and to a sphere in front of it, 0 for a miss."""

    def occupancy(points):
        return (points[:, 0] > 3.0) | (np.linalg.norm(points - [1.5, 0, 0], axis=1) < 0.5)

    directions = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [-1.0, 0, 0]])
    distances = march(occupancy, np.zeros((3, 3)), directions, 20.0)
    np.testing.assert_allclose(distances, [1.0, 5.0, 0.0], atol=5e-4)


def test_room_samples_agree_with_each_other(room):
    """Rays end on the surface, cameras stand in free space, half the near points are solid, colours fit the wall."""
    centre = BoxRoom.bounds.mean(axis=0)
    hits = room["origins"][:, None] + room["directions"] * room["distances"][..., None] + centre
    ahead = (hits + 0.005 * room["directions"]).reshape(-1, 3)
    before = (hits - 0.005 * room["directions"]).reshape(-1, 3)
    assert BoxRoom().occupancy(ahead).all() and not BoxRoom().occupancy(before).any()
    assert not BoxRoom().occupancy(room["origins"] + centre).any()
    assert 0.3 < room["occupied"][: SIZES.points // 2].mean() < 0.7
    np.testing.assert_array_equal(room["occupied"], BoxRoom().occupancy(room["points"].astype(np.float64) + centre))
    on_floor = np.abs(hits[..., 2]) < 1e-3
    assert on_floor.any() and room["ray_colors"][on_floor].argmax(axis=-1).mean() > 1.8
    assert all(array.dtype == np.float32 for name, array in room.items() if name != "occupied")


def test_pool_knows_the_vertices_its_rays_touch(room):
    """Ray samples are found again by position; a far point is reported as unknown."""
    pool = RayPool(room, np.array([0, 1]), np.random.default_rng(0), "cpu")
    batch = pool.batch(torch.arange(10))
    stencils, known = pool.locate(torch.cat([batch.points.flatten(0, 1), pool.points.amax((0, 1))[None] + 5.0]))
    assert known[:-1].all() and not known[-1]
    for level in ("middle", "fine"):
        table = torch.randn(len(pool.touched[level]), 32)
        a = interpolate(table, batch.stencils[level])
        torch.testing.assert_close(interpolate(table, stencils[level])[:-1], a, atol=1e-5, rtol=0)


def test_encoder_phase_learns(room):
    """A few steps on one room lower the cross entropy of middle and fine level and the colour error."""
    trainer = Trainer(replace(SMALL, point_count=600, cloud_size=600), [room])
    losses = [trainer.encoder_step() for _ in range(12)]
    for name in ("middle", "fine", "silence", "color"):
        first, last = (np.mean([loss[name] for loss in part]) for part in (losses[:3], losses[-3:]))
        assert last < 0.7 * first, name


def test_killed_run_continues_where_it_was(room, tmp_path):
    """Both phases: save, restore into a new trainer and go on, equals going on; other settings are refused."""
    whole, parts = Trainer(SMALL, [room]), Trainer(SMALL, [room])
    for trainer in (whole, parts):
        trainer.encoder_step()
        trainer.episode(0.2)
    parts.save(tmp_path / "checkpoint.pt")
    resumed = Trainer(SMALL, [room])
    resumed.restore(tmp_path / "checkpoint.pt")
    for trainer in (whole, resumed):
        trainer.encoder_step()
        trainer.episode(0.9)
    assert resumed.progress == whole.progress and whole.progress.episodes == 2
    for name, array in whole.weights().state_dict().items():
        np.testing.assert_array_equal(resumed.weights().state_dict()[name], array)
    with pytest.raises(CheckpointError, match="seed"):
        Trainer(replace(SMALL, seed=1), [room]).restore(tmp_path / "checkpoint.pt")


@pytest.mark.parametrize("share, levels", [(0.0, {"middle", "fine", "color"}), (1.0, {"coarse"})])
def test_an_episode_trains_its_levels(room, share, levels):
    """A room of an episode trains the coarse decoder alone, or the three others."""
    trainer = Trainer(replace(SMALL, coarse_share=share), [room])
    before = trainer.weights()
    trainer.episode(0.0)
    after = trainer.weights()
    changed = {
        level: any((getattr(after, level).tensors[n] != a).any() for n, a in getattr(before, level).tensors.items())
        for level in LEVELS
    }
    assert {level for level, value in changed.items() if value} == levels


def test_free_space_feature_is_of_free_space():
    """Where middle features move only in front of surfaces, the mean of them makes space free."""
    room = make_samples(BoxRoom(), 0, replace(SIZES, rays=200))
    feature = free_space_feature(load_decoders(), [room], iterations=15)
    points = torch.rand(50, 3)
    logits = DecoderSet(load_decoders()).middle(points, feature.expand(50, -1))
    assert feature.abs().max() > 0.05 and (logits < 0).all()


def test_packaged_decoders_beat_random_ones():
    """The weights that ship map a held-out room better, as on a first frame, and their residual starts near zero."""
    room = make_samples(make_room(HELD_OUT_SEED), HELD_OUT_SEED, replace(SIZES, cameras=3, rays=300))
    trained, chance = (fit_room(d, room, 40, 0, rays=60, factor=5.0) for d in (load_decoders(), random_decoders(0)))
    assert trained["depth_l1_cm"] < 0.7 * chance["depth_l1_cm"]
    assert trained["bce"] < 0.5 * chance["bce"]
    assert trained["residual_rms"] < 0.2 * chance["residual_rms"]


def test_commands(tmp_path, capsys):
    """train, train again (continues), evaluate and export on real rooms of tiny size."""
    out = tmp_path / "run"
    shared = ["--out", str(out), "--threads", "1", "--workers", "1", "--device", "cpu"]
    shared += ["--samples", "1500", "6000", "3", "150"]
    small = [f"--set={name}={value}" for name, value in vars(SMALL).items()]
    for _ in range(2):
        command = ["train", *shared, "--rooms", "1", "--minutes", "60", "--max-steps", "1", *small]
        assert pretrain.main(command) == 0
    assert "continuing after" in capsys.readouterr().out
    assert (out / "losses.png").stat().st_size > 1000
    also = f"--also=copy={out / 'decoders.pth'}"
    assert pretrain.main(["evaluate", *shared, "--rooms", "1", "--budgets", "3", "--rays", "10", also]) == 0
    table = (out / "evaluation.md").read_text()
    assert table.count("\n") == 5 and "| copy | 3 |" in table
    assert pretrain.main(["export", *shared, "--to", str(tmp_path / "export.pth")]) == 0
    assert load_decoders(tmp_path / "export.pth").middle.hidden == 32
    missing = ["export", "--out", str(tmp_path / "none"), "--to", str(tmp_path / "x.pth")]
    assert pretrain.main(missing) == 2 and "no such file" in capsys.readouterr().err


def test_quiet_fine_decoder_is_silent_and_else_the_same():
    """At zero feature little is left of what it said; the middle, coarse and colour decoders are untouched."""
    room = make_samples(BoxRoom(), 0, replace(SIZES, rays=200))
    weights = random_decoders(3)
    quiet = quiet_fine_decoder(weights, [room], 60, lambda line: None)
    points = torch.rand(500, 3)
    silent = torch.cat([torch.zeros(500, 32), 0.2 * torch.randn(500, 32)], dim=1)
    before, after = (LevelDecoder(w.fine)(points, silent).detach().abs().mean() for w in (weights, quiet))
    assert after < 0.5 * before
    for level in ("coarse", "middle", "color"):
        assert getattr(quiet, level) is getattr(weights, level)


def test_average_lies_between(tmp_path):
    """Each tensor is the weighted mean of the two files; the coarse decoder comes from where it is asked for."""
    for seed in (1, 2):
        random_decoders(seed).save(tmp_path / f"{seed}.pth")
    files = ["--start", str(tmp_path / "1.pth"), "--other", str(tmp_path / "2.pth"), "--share", "0.25"]
    out = tmp_path / "out"
    assert pretrain.main(["average", "--out", str(out), *files, "--coarse-from", str(tmp_path / "2.pth")]) == 0
    mixed, one, two = (load_decoders(path) for path in (out / "decoders.pth", tmp_path / "1.pth", tmp_path / "2.pth"))
    name = "pts_linears.1.weight"
    expected = 0.75 * one.fine.tensors[name] + 0.25 * two.fine.tensors[name]
    np.testing.assert_allclose(mixed.fine.tensors[name], expected, atol=1e-7)
    np.testing.assert_array_equal(mixed.coarse.tensors[name], two.coarse.tensors[name])
