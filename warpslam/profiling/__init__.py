"""Where the time of a run goes, kernel by kernel.

    with warpslam.profile() as p:
        for rgb, depth in frames:
            slam.step(rgb, depth)
    print(p.table())
    p.write_trace("trace.json")

`phases` marks the parts of the algorithm, `recorder` times launches while a profile is active, `costs` knows what a
kernel computes and moves, `report` puts it together. While no profile is active nothing of this is in a launch's way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpslam.runtime.phases import phase as phase

if TYPE_CHECKING:
    from warpslam.profiling.recorder import Profile


def profile() -> Profile:
    """A profile of what runs inside the ``with`` block, on all threads; see `warpslam.profiling.recorder.Profile`."""
    from warpslam.profiling.recorder import Profile

    return Profile()
