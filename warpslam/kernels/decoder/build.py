"""The kernels of all decoders, built for the CPU and for CUDA, for dense rows and for rows in blocks."""

from types import SimpleNamespace

import warp as wp

from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.coarse import coarse_kernels
from warpslam.kernels.decoder.color import color_kernels
from warpslam.kernels.decoder.geometry import geometry_kernels
from warpslam.kernels.decoder.layout import GROUP_SIZE, WEIGHT_GROUP, WEIGHT_SLOTS
from warpslam.kernels.decoder.scatter import scatter_kernels


def decoder_kernels(target: str, layout: str = "dense") -> SimpleNamespace:
    """Kernels of all decoders for ``target`` "cpu" or "cuda" and rows "dense" or in "blocks", in the Warp module
    ``warpslam.decoder_<target>`` or ``warpslam.decoder_<target>_blocks``.

    A launch over N samples has `thread_count(N)` threads and takes N as `Span.point_count`; one over a list of up to N
    samples has as many.
    """
    build = Build(target, layout)
    more = {} if build.on_cpu else scatter_kernels(build)
    return SimpleNamespace(
        **geometry_kernels(build),
        **color_kernels(build),
        **coarse_kernels(build),
        **more,
        # Samples of a ray between two looks at its transmittance.
        group_size=GROUP_SIZE[target],
        # Blocks of a thread of `color_backward`.
        color_blocks=WEIGHT_GROUP // build.size if build.on_cpu else 1,
        # Threads of a launch over so many samples, one block each.
        thread_count=lambda point_count: -(-point_count // build.size),
        # Whether a sample has a thread of its own: the adjoints leave the sums to `scatter_features` and
        # `color_weights`, and compositing to `warpslam.kernels.by_sample`.
        by_sample=not build.on_cpu,
        # Buffers of the colour decoder's weight gradient; None: one a slice.
        weight_slots=None if build.on_cpu else WEIGHT_SLOTS,
    )


KERNELS = {
    (target, layout): decoder_kernels(target, layout) for target in ("cpu", "cuda") for layout in ("dense", "blocks")
}


def decoders_for(device: wp.Device, layout: str = "dense") -> SimpleNamespace:
    """The decoder kernels built for this kind of device and layout; those that read no grid are alike in both."""
    return KERNELS["cuda" if device.is_cuda else "cpu", layout]
