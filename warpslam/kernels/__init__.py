"""Warp kernels, one file a stage of the pipeline. Nothing here knows about files, datasets or the command line.

The stages of one optimisation iteration, in order: `rays` (pixels, rays, samples), `decoder` (grid lookup and MLPs),
`compositing`, `losses`, `adam`. `frustum` and `grid` serve the map. Arrays of one iteration live in
`warpslam.field.ray_batch.RayBatch`, which also records the iteration on a `wp.Tape`.
"""
