"""Pose of a camera from matched points, robustly, and its normal equations.

    x = T_camera_reference X
    r_u = (fx x/z + cx - u) / s,   r_v likewise          s [px]: position of the feature
    r_d = (1/z - 1/d) / s_d                              s_d [1/m]: registration, synchronisation and noise of depth
    T <- exp(xi) T, xi = (v, w):  a row with g = dr/dx has the Jacobian [g, x cross g]
    H = J' W J,  b = J' W r,  xi = -H^-1 b

Huber at chi^2 of 95 % (5.991 for the two rows of a position, 7.815 for three). After each round of Gauss-Newton a match
is an inlier or not by the same chi^2, and the last round runs without Huber. All of it is one launch: 32 threads of a
block on CUDA sum the rows between them and solve the same 6x6 system each; on the CPU one thread does all.

With a rolling shutter a feature of row time dt sees x - dt (u_v + u_w cross x) for a twist u of the camera.
"""

import warp as wp

from warpslam.kernels.features.arrays import MODULE, Feature, Features, Matches, Motion, View
from warpslam.kernels.gauss_newton import Mat66d, Vec6d, solve

CHI2_TWO = wp.constant(5.991)
CHI2_THREE = wp.constant(7.815)
NEAREST = wp.constant(0.05)
"""Rows of points nearer than this, or behind the camera, count as outliers [m]."""
LEAST_INLIERS = wp.constant(6)
CONVERGED = wp.constant(wp.float64(1.0e-6))
DAMPING = wp.constant(wp.float64(1.0e-6))


@wp.struct
class Solver:
    """How the robust pose is found."""

    rounds: int
    iterations: int
    """At most, a round."""
    depth_sigma: float
    """s_d [1/m]."""
    edge_factor: float
    """s_d is this times larger where depth steps."""
    lanes: int
    """Threads that share the rows: those of a block on CUDA, 1 on the CPU."""


@wp.struct
class PoseState:
    """What is found. Arrays of one element, but for ``summary``."""

    T_camera_reference: wp.array[wp.mat44d]
    normal: wp.array[Mat66d]
    """H at the pose found, of its inliers."""
    right: wp.array[Vec6d]
    """b there."""
    summary: wp.array[int]
    """Matched rows; inliers among them; Gauss-Newton steps."""


@wp.struct
class Sums:
    """H in blocks (translation, mixed, rotation) and b of the rows that a thread has."""

    vv: wp.mat33d
    wv: wp.mat33d
    ww: wp.mat33d
    v: wp.vec3d
    w: wp.vec3d


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1) x += __shfl_xor_sync(0xffffffff, x, offset);
#endif
    return x;
""")
def lane_sum(x: wp.float64) -> wp.float64:
    """Sum over the 32 threads of a warp, the same in each (CUDA); itself on the CPU."""
    ...


@wp.func
def lane_sum3(x: wp.vec3d) -> wp.vec3d:
    return wp.vec3d(lane_sum(x[0]), lane_sum(x[1]), lane_sum(x[2]))


@wp.func
def rotation(w: wp.vec3d) -> wp.mat33d:
    """exp([w]x), Rodrigues."""
    angle = wp.length(w)
    W = wp.skew(w)
    one = wp.float64(1.0)
    a = one
    b = wp.float64(0.5)
    if angle > wp.float64(1.0e-8):
        a = wp.sin(angle) / angle
        b = (one - wp.cos(angle)) / (angle * angle)
    return wp.identity(n=3, dtype=wp.float64) + a * W + b * (W * W)


@wp.func
def left_jacobian(w: wp.vec3d) -> wp.mat33d:
    """V of exp((v, w)) = (exp([w]x), V v)."""
    angle = wp.length(w)
    W = wp.skew(w)
    one = wp.float64(1.0)
    a = wp.float64(0.5)
    b = wp.float64(1.0 / 6.0)
    if angle > wp.float64(1.0e-4):
        a = (one - wp.cos(angle)) / (angle * angle)
        b = (angle - wp.sin(angle)) / (angle * angle * angle)
    return wp.identity(n=3, dtype=wp.float64) + a * W + b * (W * W)


@wp.func
def orthonormal(R: wp.mat33d) -> wp.mat33d:
    """One Newton step to the nearest rotation: the product of many drifts off SO(3)."""
    return wp.float64(0.5) * (R * (wp.float64(3.0) * wp.identity(n=3, dtype=wp.float64) - wp.transpose(R) * R))


@wp.func
def seen_point(p: wp.vec3, row_time: float, motion: Motion) -> wp.vec3:
    """A point in the camera's axes at the middle row, at the time of another row."""
    return p - row_time * (motion.translation + wp.cross(motion.rotation, p))


@wp.func
def residuals(x: wp.vec3, feature: Feature, view: View, depth_weight: float) -> wp.vec3:
    """r_u, r_v, r_d of a point in front of the camera; ``depth_weight`` is 1 / s_d, 0 without depth."""
    weight = 1.0 / feature.pixel_sigma
    pixel = feature.pixel
    return wp.vec3(
        (view.focal[0] * x[0] / x[2] + view.center[0] - pixel[0]) * weight,
        (view.focal[1] * x[1] / x[2] + view.center[1] - pixel[1]) * weight,
        (1.0 / x[2] - feature.inverse_depth) * depth_weight,
    )


@wp.func
def depth_weight_of(feature: Feature, solver: Solver) -> float:
    if feature.inverse_depth <= 0.0:
        return 0.0
    return 1.0 / (solver.depth_sigma * wp.where(feature.on_edge != 0, solver.edge_factor, 1.0))


@wp.func
def chi2_limit(depth_weight: float) -> float:
    return wp.where(depth_weight > 0.0, CHI2_THREE, CHI2_TWO)


@wp.func
def by_point(g: wp.vec3, row_time: float, motion: Motion) -> wp.vec3:
    """dr/dx at the middle row, of one at the feature's row."""
    return g - row_time * wp.cross(g, motion.rotation)


@wp.func
def sum_rows(
    lane: int,
    R: wp.mat33,
    t: wp.vec3,
    matches: Matches,
    frame: Features,
    view: View,
    motion: Motion,
    solver: Solver,
    robust: bool,
) -> Sums:
    sums = Sums()
    for row in range(lane, matches.row_count, solver.lanes):
        j = matches.feature[row]
        if j >= 0:
            if matches.inlier[row] != 0:
                feature = frame.feature[j]
                middle = R * matches.point[row] + t
                dt = feature.row_time
                x = seen_point(middle, dt, motion)
                if x[2] > NEAREST:
                    depth_weight = depth_weight_of(feature, solver)
                    r = residuals(x, feature, view, depth_weight)
                    chi2 = wp.dot(r, r)
                    limit = chi2_limit(depth_weight)
                    weight = matches.weight[row]
                    if robust and chi2 > limit:
                        weight = weight * wp.sqrt(limit / chi2)
                    z = 1.0 / x[2]
                    a = view.focal[0] * z / feature.pixel_sigma
                    b = view.focal[1] * z / feature.pixel_sigma
                    gu = by_point(wp.vec3(a, 0.0, -a * x[0] * z), dt, motion)
                    gv = by_point(wp.vec3(0.0, b, -b * x[1] * z), dt, motion)
                    gd = by_point(wp.vec3(0.0, 0.0, -z * z * depth_weight), dt, motion)
                    G = weight * (wp.outer(gu, gu) + wp.outer(gv, gv) + wp.outer(gd, gd))
                    q = weight * (r[0] * gu + r[1] * gv + r[2] * gd)
                    cross = wp.skew(middle)
                    mixed = cross * G
                    sums.vv += wp.mat33d(G)
                    sums.wv += wp.mat33d(mixed)
                    sums.ww += wp.mat33d(mixed * wp.transpose(cross))
                    sums.v += wp.vec3d(q)
                    sums.w += wp.vec3d(wp.cross(middle, q))
    return sums


@wp.func
def normal_of(sums: Sums) -> Mat66d:
    H = Mat66d()
    for i in range(3):
        vv = lane_sum3(sums.vv[i])
        wv = lane_sum3(sums.wv[i])
        ww = lane_sum3(sums.ww[i])
        for k in range(3):
            H[i, k] = vv[k]
            H[3 + i, k] = wv[k]
            H[k, 3 + i] = wv[k]
            H[3 + i, 3 + k] = ww[k]
    return H


@wp.func
def right_of(sums: Sums) -> Vec6d:
    v = lane_sum3(sums.v)
    w = lane_sum3(sums.w)
    return Vec6d(v[0], v[1], v[2], w[0], w[1], w[2])


@wp.func
def classify(
    lane: int,
    R: wp.mat33,
    t: wp.vec3,
    matches: Matches,
    frame: Features,
    view: View,
    motion: Motion,
    solver: Solver,
) -> wp.vec2i:
    """Marks the inliers among a thread's rows; number of matched rows and of inliers of all threads."""
    matched = int(0)
    good = int(0)
    for row in range(lane, matches.row_count, solver.lanes):
        j = matches.feature[row]
        if j >= 0:
            matched += 1
            inside = int(0)
            error = float(0.0)
            feature = frame.feature[j]
            x = seen_point(R * matches.point[row] + t, feature.row_time, motion)
            if x[2] > NEAREST:
                depth_weight = depth_weight_of(feature, solver)
                r = residuals(x, feature, view, depth_weight)
                inside = wp.where(wp.dot(r, r) <= chi2_limit(depth_weight), 1, 0)
                if depth_weight > 0.0:
                    error = 1.0 / x[2] - feature.inverse_depth
            good += inside
            matches.inlier[row] = inside
            matches.depth_error[row] = error
    return wp.vec2i(int(lane_sum(wp.float64(matched))), int(lane_sum(wp.float64(good))))


@wp.func
def rotation_part(T: wp.mat44d) -> wp.mat33d:
    return wp.mat33d(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.kernel(module=MODULE)
def robust_pose(
    matches: Matches,
    frame: Features,
    view: View,
    motion: Motion,
    solver: Solver,
    T_start: wp.array[wp.mat44d],
    state: PoseState,
):
    """The whole loop, from ``T_start``; ``solver.lanes`` threads, which is one block."""
    lane = wp.tid()
    T = T_start[0]
    R = rotation_part(T)
    t = wp.vec3d(T[0, 3], T[1, 3], T[2, 3])
    for row in range(lane, matches.row_count, solver.lanes):
        matches.inlier[row] = wp.where(matches.feature[row] >= 0, 1, 0)
    counts = wp.vec2i()
    steps = int(0)
    n = int(0)
    while n < solver.rounds:
        iteration = int(0)
        while iteration < solver.iterations:
            sums = sum_rows(lane, wp.mat33(R), wp.vec3(t), matches, frame, view, motion, solver, n < solver.rounds - 1)
            H = normal_of(sums)
            for k in range(6):
                H[k, k] = H[k, k] + DAMPING
            step = -solve(H, right_of(sums))
            v = wp.vec3d(step[0], step[1], step[2])
            w = wp.vec3d(step[3], step[4], step[5])
            dR = rotation(w)
            R = orthonormal(dR * R)
            t = dR * t + left_jacobian(w) * v
            steps += 1
            iteration += 1
            if wp.length(v) < CONVERGED and wp.length(w) < CONVERGED:
                iteration = solver.iterations
        counts = classify(lane, wp.mat33(R), wp.vec3(t), matches, frame, view, motion, solver)
        n += 1
        if counts[1] < LEAST_INLIERS:
            n = solver.rounds
    sums = sum_rows(lane, wp.mat33(R), wp.vec3(t), matches, frame, view, motion, solver, False)
    H = normal_of(sums)
    b = right_of(sums)
    if lane == 0:
        found = wp.identity(n=4, dtype=wp.float64)
        for i in range(3):
            for k in range(3):
                found[i, k] = R[i, k]
            found[i, 3] = t[i]
        state.T_camera_reference[0] = found
        state.normal[0] = H
        state.right[0] = b
        state.summary[0] = counts[0]
        state.summary[1] = counts[1]
        state.summary[2] = steps


@wp.kernel(module=MODULE)
def normal_equations(
    matches: Matches,
    frame: Features,
    view: View,
    motion: Motion,
    solver: Solver,
    T_camera_reference: wp.array[wp.mat44d],
    state: PoseState,
):
    """H and b of all matches at a given pose, with Huber; which are inliers there; `Solver.lanes` threads."""
    lane = wp.tid()
    T = T_camera_reference[0]
    R = wp.mat33(rotation_part(T))
    t = wp.vec3(wp.vec3d(T[0, 3], T[1, 3], T[2, 3]))
    for row in range(lane, matches.row_count, solver.lanes):
        matches.inlier[row] = 1
    sums = sum_rows(lane, R, t, matches, frame, view, motion, solver, True)
    H = normal_of(sums)
    b = right_of(sums)
    counts = classify(lane, R, t, matches, frame, view, motion, solver)
    if lane == 0:
        state.T_camera_reference[0] = T
        state.normal[0] = H
        state.right[0] = b
        state.summary[0] = counts[0]
        state.summary[1] = counts[1]
        state.summary[2] = 0
