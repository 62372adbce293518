"""Gauss-Newton over the levels of a pyramid: one group of threads a start, from the first level to the last on its own.

Nothing comes back to the host in between: a group goes through the steps of `register` (the cost at the start, the
scales of a level, its iterations, a record of it, the cost at the end), each of which is one evaluation.
"""

import warp as wp

from warpslam.kernels.direct.equations import (
    AGREE,
    COST,
    DEPTH_COUNT,
    DEPTH_SCALE,
    GREY_COUNT,
    GREY_SCALE,
    IN_VIEW,
    POINTS,
    Mat66,
    Mat88,
    Vec6,
    Vec8,
    Vec16,
    Weights,
    depth_at,
    depth_sigma,
    evaluate,
    exponential,
    inverted,
    logarithm,
    rectified,
    scaled,
    solve8,
)
from warpslam.kernels.direct.images import MODULE, Images, Level
from warpslam.kernels.direct.points import MIN_DEPTH, Motion, Points, inside

RECORDS = 2
"""Levels of which a result keeps the counts: the two largest."""
MAX_JOINT = 4
"""Keyframes that one pose is registered to at once."""

_COST = wp.constant(COST)
_IN_VIEW = wp.constant(IN_VIEW)
_GREY_COUNT = wp.constant(GREY_COUNT)
_DEPTH_COUNT = wp.constant(DEPTH_COUNT)
_AGREE = wp.constant(AGREE)
_POINTS = wp.constant(POINTS)
_GREY_SCALE = wp.constant(GREY_SCALE)
_DEPTH_SCALE = wp.constant(DEPTH_SCALE)
_RECORDS = wp.constant(RECORDS)

GAIN_PRIOR = wp.constant(100.0)
BIAS_PRIOR = wp.constant(1.0e-3)
MAX_TURN = wp.constant(0.2)
"""Of one step [rad]."""
STOP = wp.constant(1.0e-4)
"""Shift [m] and turn [rad] of a step after which a level of unit size is done."""
COST_GREY_SCALE = wp.constant(12.0)
COST_DEPTH_SCALE = wp.constant(8.0)
OUT_OF_VIEW = wp.constant(0.3)
"""Cost of a point that is not in view: a higher one draws to poses that see all."""

GLANCE = wp.constant(3)
FIRST_WIDTH = wp.constant(20.0)
ANNEALING = wp.constant(0.6)
START_COST = wp.constant(0)
SCALE = wp.constant(1)
STEP = wp.constant(2)
RECORD = wp.constant(3)
END_COST = wp.constant(4)
DONE = wp.constant(5)


@wp.struct
class Task:
    """A registration that is asked for."""

    keyframe: int
    """Row of its points."""
    row: int
    """Of the frame's images."""
    top: int
    """First level."""
    low: int
    """Last level."""
    iterations: int
    """At each level; 0 = as many as the level has, -1 = none, -2 = nothing but the cost at the start."""
    cost_level: int
    """Where the costs at start and end are taken; -1 = nowhere."""
    grey: float
    """Weight of the photometric residual."""
    depth: float
    """Weight of the geometric one."""
    T: wp.mat44
    """Start: from the keyframe's axes to those of the frame."""
    exposure: wp.vec2
    """Gain and bias to start from."""


@wp.struct
class Result:
    """What came of a `Task`."""

    T: wp.mat44
    exposure: wp.vec2
    start_cost: float
    end_cost: float
    ok: int
    """0 where too few points were in view."""
    H: Mat66
    """Normal matrix of the pose, gain and bias eliminated, at the last level."""
    record_0: Vec16
    """Counts and scales at level 0, if it was reached."""
    record_1: Vec16
    """Counts and scales at level 1, if it was reached."""


@wp.struct
class Floors:
    """Least scales."""

    grey: float
    depth: float


@wp.func
def damped_step(H: Mat88, g: Vec8, exposure: wp.vec2) -> Vec8:
    """A Gauss-Newton step, damped, with a weak prior that keeps the gain where the image is flat."""
    A = Mat88(H)
    b = Vec8(g)
    for k in range(6):
        A[k, k] = A[k, k] * 1.0001 + 1.0e-3
    A[6, 6] += GAIN_PRIOR
    A[7, 7] += BIAS_PRIOR
    b[6] += GAIN_PRIOR * (exposure[0] - 1.0)
    x = -solve8(A, b)
    turn = wp.length(wp.vec3(x[3], x[4], x[5]))
    if turn > MAX_TURN:
        for k in range(6):
            x[k] = x[k] * MAX_TURN / turn
    return x


@wp.func
def moved(T: wp.mat44, x: Vec8) -> wp.mat44:
    return rectified(exponential(wp.vec3(x[0], x[1], x[2]), wp.vec3(x[3], x[4], x[5])) * T)


@wp.func
def exposed(exposure: wp.vec2, x: Vec8) -> wp.vec2:
    return wp.vec2(wp.clamp(exposure[0] + x[6], 0.3, 3.0), exposure[1] + x[7])


@wp.func
def is_still(x: Vec8, n: int) -> bool:
    limit = STOP * float(1 << n)
    return wp.length(wp.vec3(x[0], x[1], x[2])) < limit and wp.length(wp.vec3(x[3], x[4], x[5])) < limit


@wp.func
def pose_part(H: Mat88) -> Mat66:
    """The pose's normal matrix after gain and bias were eliminated."""
    a = H[6, 6] + GAIN_PRIOR
    b = H[6, 7]
    c = H[7, 7] + BIAS_PRIOR
    det = a * c - b * b
    out = Mat66()
    for i in range(6):
        for j in range(6):
            left = (c * H[i, 6] - b * H[i, 7]) / det
            right = (a * H[i, 7] - b * H[i, 6]) / det
            out[i, j] = H[i, j] - left * H[j, 6] - right * H[j, 7]
    return out


@wp.func
def cost_of(counts: Vec16) -> float:
    """Mean robust cost a point; those out of view cost little, unless nearly all are."""
    n = wp.max(counts[_POINTS], 1.0)
    cost = (counts[_COST] + OUT_OF_VIEW * (n - counts[_IN_VIEW])) / n
    if counts[_IN_VIEW] < 0.2 * n:
        cost += 4.0
    return cost


@wp.func
def with_scales(grey: float, depth: float, grey_scale: float, depth_scale: float) -> Weights:
    weights = Weights()
    weights.grey = grey
    weights.depth = depth
    weights.grey_scale = grey_scale
    weights.depth_scale = depth_scale
    return weights


@wp.kernel(module=MODULE, enable_backward=False)
def register(
    levels: wp.array[Level],
    iterations: wp.array[int],
    floors: Floors,
    points: Points,
    images: Images,
    motions: wp.array[Motion],
    tasks: wp.array[Task],
    first: int,
    lanes: int,
    histograms: wp.array2d[int],
    results: wp.array[Result],
):
    """Tasks from number ``first`` on, ``lanes`` threads each."""
    tid = wp.tid()
    number = first + tid // lanes
    lane = tid - (tid // lanes) * lanes
    task = tasks[number]
    motion = motions[task.row]
    bins = histograms[number]
    result = Result()
    T = task.T
    exposure = task.exposure
    n = task.top
    done = int(0)
    width = float(0.0)
    phase = int(SCALE)
    if task.cost_level >= 0:
        phase = START_COST
    costs = with_scales(1.0, 1.0, COST_GREY_SCALE, COST_DEPTH_SCALE)
    weights = with_scales(task.grey, task.depth, 20.0, 5.0)
    result.ok = 1
    # A first look at many starts need not be at every point.
    stride = int(1)
    if task.iterations == -2:
        stride = GLANCE
    while phase != DONE:
        at = n
        gate = float(1.0e9)
        current = costs
        if phase == START_COST or phase == END_COST:
            at = task.cost_level
        else:
            gate = levels[n].gate
            current = weights
        sums = evaluate(
            levels[at],
            points,
            task.keyframe,
            images,
            task.row,
            motion,
            T,
            exposure,
            current,
            gate,
            stride,
            lane,
            lanes,
            bins,
        )
        if phase == START_COST:
            result.start_cost = cost_of(sums.counts)
            phase = SCALE
            if task.iterations == -2:
                phase = DONE
        elif phase == SCALE:
            width = FIRST_WIDTH
            weights = scaled(weights, sums.counts, bins, width, floors.depth)
            done = 0
            phase = STEP
            if task.iterations < 0:
                phase = RECORD
        elif phase == STEP:
            if sums.counts[_GREY_COUNT] + sums.counts[_DEPTH_COUNT] < 30.0:
                result.ok = 0
                phase = DONE
            else:
                x = damped_step(sums.H, sums.g, exposure)
                T = moved(T, x)
                exposure = exposed(exposure, x)
                width = wp.max(floors.grey, width * ANNEALING)
                weights = scaled(weights, sums.counts, bins, width, floors.depth)
                done += 1
                limit = task.iterations
                if limit == 0:
                    limit = iterations[n]
                if done >= limit or (is_still(x, n) and width <= floors.grey):
                    if n == task.low or n < _RECORDS:
                        phase = RECORD
                    else:
                        n -= 1
                        weights = with_scales(task.grey, task.depth, 20.0, 5.0)
                        phase = SCALE
        elif phase == RECORD:
            record = sums.counts
            record[_GREY_SCALE] = weights.grey_scale
            record[_DEPTH_SCALE] = weights.depth_scale
            if n == 0:
                result.record_0 = record
            elif n == 1:
                result.record_1 = record
            if n > task.low:
                n -= 1
                weights = with_scales(task.grey, task.depth, 20.0, 5.0)
                phase = SCALE
            else:
                result.H = pose_part(sums.H)
                phase = DONE
                if task.cost_level >= 0:
                    phase = END_COST
        else:
            result.end_cost = cost_of(sums.counts)
            phase = DONE
    result.T = T
    result.exposure = exposure
    if lane == 0:
        results[number] = result


Mat86 = wp.types.matrix(shape=(8, 6), dtype=wp.float32)
Mat84 = wp.types.matrix(shape=(8, 4), dtype=wp.float32)


@wp.struct
class Joint:
    """A pose that is registered to several keyframes at once, and to whose motion the images are corrected first."""

    row: int
    """Of the frame's images."""
    count: int
    """Keyframes, the reference first."""
    keyframes: wp.vec4i
    """Rows of their points."""
    level: int
    iterations: int
    grey: float
    depth: float
    T_earlier_reference: wp.mat44
    """From the reference's axes to those of an earlier frame."""
    elapsed: float
    """Time since that frame [s]; 0 = the motion stays as it is."""
    delay: float
    """Of the depth image against the colour image [s]."""
    readout: float
    """[s]"""
    others: int
    """Of the `OtherRows` that join."""


@wp.struct
class OtherRows:
    """Normal equations of a pose from elsewhere (features, the map), which join those of the keyframes."""

    T: wp.mat44
    """From the reference's axes to the frame's, where they hold."""
    H: Mat66
    """Of T <- exp(xi) T; residuals in units of their standard deviation."""
    g: Vec6


@wp.kernel(module=MODULE, enable_backward=False)
def register_jointly(
    levels: wp.array[Level],
    floors: Floors,
    points: Points,
    images: Images,
    motions: wp.array[Motion],
    joints: wp.array[Joint],
    to_reference: wp.array[wp.mat44],
    others: wp.array[OtherRows],
    start: wp.array[Result],
    lanes: int,
    histograms: wp.array2d[int],
    results: wp.array[Result],
):
    """The pose of ``start`` on; gain and bias of each keyframe are eliminated. ``to_reference``: from the axes of each
    keyframe to those of the reference.
    """
    lane = wp.tid()
    joint = joints[0]
    result = start[0]
    T = result.T
    bins = histograms[0]
    motion = motions[joint.row]
    if joint.elapsed > 0.0:
        twist = logarithm(joint.T_earlier_reference * inverted(T)) / joint.elapsed
        v = wp.vec3(twist[0], twist[1], twist[2])
        w = wp.vec3(twist[3], twist[4], twist[5])
        motion.to_depth = exponential(-joint.delay * v, -joint.delay * w)
        motion.velocity = joint.readout * v
        motion.spin = joint.readout * w
        motion.moves = 1
    exposures = Vec8(1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0)
    scales = Vec8(20.0, 5.0, 20.0, 5.0, 20.0, 5.0, 20.0, 5.0)
    cross = Mat86()
    own = Mat84()
    A = Mat88()
    g = Vec8()
    k = int(0)
    done = int(0)
    begins = bool(True)
    level = levels[joint.level]
    while done < joint.iterations and result.ok != 0:
        exposure = wp.vec2(exposures[2 * k], exposures[2 * k + 1])
        weights = with_scales(joint.grey, joint.depth, scales[2 * k], scales[2 * k + 1])
        sums = evaluate(
            level,
            points,
            joint.keyframes[k],
            images,
            joint.row,
            motion,
            T * to_reference[k],
            exposure,
            weights,
            level.gate,
            1,
            lane,
            lanes,
            bins,
        )
        new = scaled(weights, sums.counts, bins, floors.grey, floors.depth)
        scales[2 * k] = new.grey_scale
        scales[2 * k + 1] = new.depth_scale
        if begins:
            begins = False
        else:
            a = sums.H[6, 6] + GAIN_PRIOR
            b = sums.H[6, 7]
            c = sums.H[7, 7] + BIAS_PRIOR
            ra = sums.g[6] + GAIN_PRIOR * (exposure[0] - 1.0)
            rb = sums.g[7]
            det = a * c - b * b
            for i in range(6):
                left = (c * sums.H[i, 6] - b * sums.H[i, 7]) / det
                right = (a * sums.H[i, 7] - b * sums.H[i, 6]) / det
                for j in range(6):
                    A[i, j] += sums.H[i, j] - left * sums.H[j, 6] - right * sums.H[j, 7]
                g[i] += sums.g[i] - left * ra - right * rb
                cross[2 * k, i] = sums.H[i, 6]
                cross[2 * k + 1, i] = sums.H[i, 7]
            own[2 * k, 0] = c / det
            own[2 * k, 1] = -b / det
            own[2 * k + 1, 0] = -b / det
            own[2 * k + 1, 1] = a / det
            own[2 * k, 2] = ra
            own[2 * k + 1, 2] = rb
            k += 1
            begins = done == 0
            if k == joint.count:
                for m in range(joint.others):
                    other = others[m]
                    moved_by = logarithm(T * inverted(other.T))
                    step = other.g + other.H * moved_by
                    for i in range(6):
                        for j in range(6):
                            A[i, j] += other.H[i, j]
                        g[i] += step[i]
                for i in range(6):
                    for j in range(6):
                        result.H[i, j] = A[i, j]
                    A[i, i] += 1.0e-3
                A[6, 6] = 1.0
                A[7, 7] = 1.0
                x = -solve8(A, g)
                for m in range(joint.count):
                    da = own[2 * m, 2]
                    db = own[2 * m + 1, 2]
                    for i in range(6):
                        da += cross[2 * m, i] * x[i]
                        db += cross[2 * m + 1, i] * x[i]
                    gain = exposures[2 * m] - own[2 * m, 0] * da - own[2 * m, 1] * db
                    exposures[2 * m] = wp.clamp(gain, 0.3, 3.0)
                    exposures[2 * m + 1] = exposures[2 * m + 1] - own[2 * m + 1, 0] * da - own[2 * m + 1, 1] * db
                T = moved(T, x)
                A = Mat88()
                g = Vec8()
                k = 0
                done += 1
                begins = False
                if is_still(x, joint.level):
                    done = joint.iterations
    result.T = T
    if lane == 0:
        motions[joint.row] = motion
        results[0] = result


@wp.struct
class Pair:
    """A keyframe's points and the frame that they are evaluated in."""

    keyframe: int
    row: int
    T: wp.mat44
    exposure: wp.vec2
    scales: wp.vec2


@wp.struct
class PairSums:
    """Normal equations of a `Pair` before gain and bias are eliminated, and its scales."""

    H: Mat88
    g: Vec8
    counts: Vec16
    scales: wp.vec2


@wp.kernel(module=MODULE, enable_backward=False)
def sum_pairs(
    levels: wp.array[Level],
    n: int,
    grey: float,
    depth: float,
    floors: Floors,
    points: Points,
    images: Images,
    motions: wp.array[Motion],
    pairs: wp.array[Pair],
    first: int,
    lanes: int,
    histograms: wp.array2d[int],
    sums: wp.array[PairSums],
):
    """Pairs from number ``first`` on, ``lanes`` threads each; a pair whose scales are 0 gets them first."""
    tid = wp.tid()
    number = first + tid // lanes
    lane = tid - (tid // lanes) * lanes
    pair = pairs[number]
    bins = histograms[number]
    level = levels[n]
    weights = with_scales(grey, depth, pair.scales[0], pair.scales[1])
    rounds = int(1)
    if pair.scales[0] == 0.0:
        weights = with_scales(grey, depth, 20.0, 5.0)
        rounds = 2
    out = PairSums()
    while rounds > 0:
        found = evaluate(
            level,
            points,
            pair.keyframe,
            images,
            pair.row,
            motions[pair.row],
            pair.T,
            pair.exposure,
            weights,
            level.gate,
            1,
            lane,
            lanes,
            bins,
        )
        weights = scaled(weights, found.counts, bins, floors.grey, floors.depth)
        out.H = found.H
        out.g = found.g
        out.counts = found.counts
        rounds -= 1
    out.scales = wp.vec2(weights.grey_scale, weights.depth_scale)
    if lane == 0:
        sums[number] = out


@wp.kernel(module=MODULE, enable_backward=False)
def look_back(pose: wp.array[Result], pairs: wp.array[Pair]):
    """Give a pair the inverse of a pose."""
    pairs[0].T = inverted(pose[0].T)


@wp.kernel(module=MODULE, enable_backward=False)
def overlaps(
    levels: wp.array[Level],
    n: int,
    stride: int,
    points: Points,
    images: Images,
    row: int,
    motions: wp.array[Motion],
    T_frame_reference: wp.array[Result],
    keyframes: wp.array[int],
    to_reference: wp.array[wp.mat44],
    shares: wp.array[float],
):
    """Share of each keyframe's points that the frame sees at the depth expected, one thread a keyframe."""
    tid = wp.tid()
    level = levels[n]
    G = motions[row].to_depth * T_frame_reference[0].T * to_reference[tid]
    known = float(0.0)
    agree = float(0.0)
    for k in range(level.first_point, level.first_point + level.points, stride):
        X = points.position[keyframes[tid], k]
        if X[2] > 0.0:
            known += 1.0
            q = wp.transform_point(G, X)
            if q[2] > MIN_DEPTH:
                u = level.fx * q[0] / q[2] + level.cx
                v = level.fy * q[1] / q[2] + level.cy
                if inside(u, v, level):
                    d = depth_at(images, row, level, u, v)
                    s = depth_sigma(q[2])
                    if d > 0.0 and wp.abs(d - q[2]) <= wp.max(6.0 * s, 0.02 * q[2]):
                        agree += 1.0
    shares[tid] = agree / wp.max(known, 1.0)


@wp.kernel(module=MODULE, enable_backward=False)
def search_rotations(
    levels: wp.array[Level],
    smallest: wp.array2d[float],
    images: Images,
    row: int,
    rotations: wp.array[wp.mat33],
    scores: wp.array2d[float],
):
    """1 - correlation of the smallest grey images under a rotation, K R K^-1, more where less of one is in the other.

    ``smallest``: of the frames that rotations start from, a row each.
    """
    which, n = wp.tid()
    level = levels[levels.shape[0] - 1]
    R = rotations[n]
    count = float(0.0)
    a = float(0.0)
    b = float(0.0)
    aa = float(0.0)
    bb = float(0.0)
    ab = float(0.0)
    for i in range(level.width * level.height):
        v = i // level.width
        u = i - v * level.width
        p = R * wp.vec3((float(u) - level.cx) / level.fx, (float(v) - level.cy) / level.fy, 1.0)
        if p[2] > MIN_DEPTH:
            x = level.fx * p[0] / p[2] + level.cx
            y = level.fy * p[1] / p[2] + level.cy
            if x >= 0.0 and y >= 0.0 and x < float(level.width) - 1.001 and y < float(level.height) - 1.001:
                iu = int(x)
                iv = int(y)
                s = x - float(iu)
                t = y - float(iv)
                at = level.first + iv * level.width + iu
                upper = (1.0 - s) * images.grey[row, at] + s * images.grey[row, at + 1]
                lower = (1.0 - s) * images.grey[row, at + level.width] + s * images.grey[row, at + level.width + 1]
                shade = (1.0 - t) * upper + t * lower
                key = smallest[which, i]
                count += 1.0
                a += key
                b += shade
                aa += key * key
                bb += shade * shade
                ab += key * shade
    total = float(level.width * level.height)
    score = float(2.0)
    if count >= 0.2 * total:
        va = aa / count - (a / count) * (a / count)
        vb = bb / count - (b / count) * (b / count)
        both = ab / count - (a / count) * (b / count)
        score = 1.0 - both / wp.sqrt(wp.max(va * vb, 0.0) + 1.0e-6) + 0.3 * (1.0 - count / total)
    scores[which, n] = score
