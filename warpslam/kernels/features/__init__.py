"""Kernels of sparse features: matching by projection, the pose from matches, agreement of depth images.

One Warp module. The robust pose, all rounds and iterations of it, is one launch: nothing comes back in between.
"""
