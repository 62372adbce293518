"""Matching by projection: for each 3D point the feature near its projection whose descriptor differs least.

    x = T_camera_reference T_reference_source X,  (u, v) = pi(x),  radius r = r_0 factor^octave
    octave: that of the point, less log(|x| / |X|) / log(factor); features within 2 of it are compared

A match needs few bits of difference (``limit``), and fewer than ``ratio`` times those of the second best where that one
is of the same octave. Of the points of a slot that want one feature the one with the least difference gets it.
"""

import warp as wp

from warpslam.kernels.features.arrays import KEY_UNIT, MODULE, NO_OWNER, Features, Matches, View

NEAREST = wp.constant(0.1)
"""Points nearer than this are not looked for [m]."""
OCTAVES_BESIDE = wp.constant(2)


@wp.struct
class Search:
    """What counts as a match."""

    radius: float
    """[px] in octave 0."""
    limit: int
    """Bits that descriptors may differ by."""
    ratio: float


@wp.func
def differing_bits(a: wp.array2d[wp.uint64], i: int, b: wp.array2d[wp.uint64], j: int) -> int:
    total = int(0)
    for k in range(4):
        total += int(wp.bit_count(a[i, k] ^ b[j, k]))
    return total


@wp.kernel(module=MODULE)
def match_points(
    source: Features,
    target: Features,
    view: View,
    T_reference_source: wp.mat44,
    T_camera_reference: wp.array[wp.mat44d],
    search: Search,
    slot: int,
    matches: Matches,
):
    """One thread a row of a slot; fills the slot's points, features and keys, and lowers ``owner``."""
    i = wp.tid()
    row = slot * matches.stride + i
    matches.feature[row] = -1
    if i >= source.count:
        return
    sought = source.feature[i]
    if sought.inverse_depth <= 0.0:
        return
    X = sought.point
    p = wp.transform_point(T_reference_source, X)
    x = wp.transform_point(wp.mat44(T_camera_reference[0]), p)
    if x[2] < NEAREST:
        return
    u = view.focal[0] * x[0] / x[2] + view.center[0]
    v = view.focal[1] * x[1] / x[2] + view.center[1]
    if u < 0.0 or v < 0.0 or u > view.size[0] - 1.0 or v > view.size[1] - 1.0:
        return
    factor = wp.log(view.octave_factor)
    level = sought.octave + int(wp.rint(wp.log(wp.length(X) / wp.length(x)) / factor))
    if level < -OCTAVES_BESIDE or level >= view.octaves + OCTAVES_BESIDE:
        return
    radius = search.radius * wp.exp(factor * float(wp.clamp(level, 0, view.octaves - 1)))
    first = wp.clamp(int((u - radius) / view.cell), 0, view.columns - 1)
    last = wp.clamp(int((u + radius) / view.cell), 0, view.columns - 1)
    top = wp.clamp(int((v - radius) / view.cell), 0, view.rows - 1)
    bottom = wp.clamp(int((v + radius) / view.cell), 0, view.rows - 1)
    best = int(257)
    second = int(257)
    which = int(-1)
    best_octave = int(-1)
    second_octave = int(-1)
    for line in range(top, bottom + 1):
        for j in range(target.starts[line * view.columns + first], target.starts[line * view.columns + last + 1]):
            octave = target.feature[j].octave
            if octave >= level - OCTAVES_BESIDE and octave <= level + OCTAVES_BESIDE:
                away = target.feature[j].pixel - wp.vec2(u, v)
                if wp.dot(away, away) <= radius * radius:
                    bits = differing_bits(source.descriptor, i, target.descriptor, j)
                    if bits < best:
                        second = best
                        second_octave = best_octave
                        best = bits
                        best_octave = octave
                        which = j
                    elif bits < second:
                        second = bits
                        second_octave = octave
    if which < 0 or best > search.limit:
        return
    if best_octave == second_octave and float(best) > search.ratio * float(second):
        return
    matches.point[row] = p
    matches.feature[row] = which
    matches.key[row] = best * KEY_UNIT + i
    wp.atomic_min(matches.owner, slot, which, best * KEY_UNIT + i)


@wp.kernel(module=MODULE)
def settle_matches(matches: Matches):
    """Takes features from the points that do not own them; weights by the number of slots."""
    row = wp.tid()
    feature = matches.feature[row]
    if feature < 0:
        return
    if matches.owner[row / matches.stride, feature] != matches.key[row]:
        matches.feature[row] = -1
        return
    slots = int(0)
    for slot in range(matches.slot_count):
        if matches.owner[slot, feature] < NO_OWNER:
            slots += 1
    matches.weight[row] = 1.0 / float(slots)
