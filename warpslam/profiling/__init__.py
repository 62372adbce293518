"""Where the time of a run goes, kernel by kernel.

    with warpslam.profile() as p:
        for rgb, depth in frames:
            slam.step(rgb, depth)
    print(p.table())
    p.write_trace("trace.json")

`recorder` times launches while a profile is active and keeps `records` of them, `costs` knows what a kernel computes
and moves, `report` and `trace` show it, and `session` has the `Profile` that a user holds. `warpslam.runtime.phases`
marks the parts of the algorithm. While no profile is active nothing of this is in a launch's way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpslam.runtime.phases import phase as phase

if TYPE_CHECKING:
    from warpslam.profiling.session import Profile


def profile() -> Profile:
    """A profile of what runs inside the ``with`` block, on all threads; see `warpslam.profiling.session.Profile`."""
    from warpslam.profiling.session import Profile  # with Warp, which `warpslam.profile` alone does not need

    return Profile()
