"""Programs to start from, each of them a page: ``python -m warpslam.examples.first_steps``.

All but the last run without data, in a rendered room, in less than a minute once the kernels are compiled.

    first_steps         a sequence in, trajectory and mesh out
    own_camera          a loop over the arrays of one's own camera, with frames that are no use
    known_poses         a map from poses that are known, and views of it
    localize_in_a_map   a saved map, in which a camera finds its place
    live_camera         a camera that is running: the newest frame is used, the others are dropped
    own_reader          a reader for a format of one's own, which takes the name of a file
"""
