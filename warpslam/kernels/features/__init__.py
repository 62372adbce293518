"""Kernels of sparse features: matching by projection, the pose from matches, agreement of depth images.

One Warp module. Poses `T_camera_reference` are on the device, so that a match, the pose from it, a second match with
that pose and the pose from all follow one another without the host.
"""
