"""A small ORB vocabulary in ORB-SLAM's text format, for where the full one (139 MB) can't be had.

Hierarchical k-medians over ORB descriptors: ten branches, at most six levels, nodes with fewer than 20 descriptors are
words; TF-IDF weights.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import cv2
import numpy as np

from tools.peers.recording import Recording
from warpslam.spread import spread

BRANCHES, LEVELS, SMALLEST = 10, 6, 20
IMAGES = 400
FEATURES = 1000
ROUNDS = 8


def make_vocabulary(path: Path, recording: Recording, *, seed: int = 0) -> int:
    """Write a vocabulary of the images of a recording (at most 400 of them) and return the number of its words."""
    orb = cv2.ORB.create(FEATURES)
    descriptors, owners = [], []
    chosen = spread(len(recording), min(IMAGES, len(recording)))
    for image, number in enumerate(chosen):
        _, found = orb.detectAndCompute(cv2.cvtColor(recording[int(number)].rgb, cv2.COLOR_RGB2GRAY), None)
        if found is not None:
            descriptors.append(found)
            owners.append(np.full(len(found), image))
    lines, words = tree(np.concatenate(descriptors), np.concatenate(owners), len(chosen), np.random.default_rng(seed))
    # No line break at the end: the reader would take what follows for another node.
    path.write_text(f"{BRANCHES} {LEVELS} 0 0\n" + "\n".join(lines))
    return words


def tree(
    descriptors: np.ndarray, owners: np.ndarray, image_count: int, rng: np.random.Generator
) -> tuple[list[str], int]:
    """Nodes of the vocabulary, breadth first.

    Args:
        descriptors: uint8, shape (N, 32), N >= 10.
        owners: Image that each comes from, int, shape (N,).
        image_count: Number of images.
        rng: Source of the first centres.

    Returns:
        A line "parent is_word 32 bytes weight" a node, and the number of words.
    """
    bits = np.unpackbits(descriptors, axis=1)
    lines: list[str] = []
    words = 0
    waiting = deque([(0, np.arange(len(descriptors)), 0)])  # number of the parent, its descriptors, its level
    while waiting:
        parent, members, level = waiting.popleft()
        centers, label = _medians(bits[members], rng)
        for branch in range(BRANCHES):
            own = members[label == branch]
            if not len(own):
                continue
            is_word = level + 1 == LEVELS or len(own) < SMALLEST
            weight = np.log(image_count / len(np.unique(owners[own]))) if is_word else 0.0
            lines.append(f"{parent} {int(is_word)} {' '.join(map(str, np.packbits(centers[branch])))} {weight:.6g}")
            words += is_word
            if not is_word:
                waiting.append((len(lines), own, level + 1))
    return lines, words


def _medians(bits: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Centres, shape (BRANCHES, 256), and the nearest of each row of ``bits``."""
    centers = bits[rng.choice(len(bits), BRANCHES, replace=False)]
    for _ in range(ROUNDS):
        label = _nearest(bits, centers)
        for branch in range(BRANCHES):
            if (label == branch).any():
                centers[branch] = bits[label == branch].mean(axis=0) > 0.5
    return centers, _nearest(bits, centers)


def _nearest(bits: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Index of the centre at the smallest Hamming distance, from inner products of bits."""
    a, b = bits.astype(np.float32), centers.astype(np.float32)
    return (b.sum(axis=1)[None] - 2 * a @ b.T).argmin(axis=1)
