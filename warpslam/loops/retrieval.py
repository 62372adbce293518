"""Which images show the place that another one shows: words of ORB descriptors, by locality-sensitive hashing.

A word is `BITS` bits of a descriptor, chosen once for each of `TABLES` tables; descriptors of one corner in two images
differ in few bits, so that some of their words are the same, while those of two corners hardly ever are. Nothing is
trained, and nothing is random but the choice of bits, which is always the same. The words of an image go into a table
of fixed size, which keeps for each the last `DEPTH` images that had it: what is everywhere is soon forgotten, and
memory is bounded. Two images are alike by the number of words that they share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

TABLES, BITS = 32, 20
MOST_DESCRIPTORS = 400
"""Of an image, evenly over it."""
SLOTS, DEPTH = 1 << 21, 4
"""Of the table: 32 MB."""
LEAST_DESCRIPTORS = 20
"""An image with fewer tells of no place."""
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # of Fibonacci hashing
_SEED = 20


@dataclass(frozen=True, eq=False)
class Words:
    """Words of an image: what is kept of it to find it by."""

    slots: np.ndarray
    """Of the table, sorted, int32 (n,)."""

    @classmethod
    def of(cls, descriptors: np.ndarray) -> Words:
        """From descriptors, uint8 (n, 32)."""
        if len(descriptors) < LEAST_DESCRIPTORS:
            return cls(np.zeros(0, np.int32))
        if len(descriptors) > MOST_DESCRIPTORS:
            descriptors = descriptors[np.linspace(0, len(descriptors) - 1, MOST_DESCRIPTORS).astype(int)]
        # Whole numbers below 2^20: exact in float32.
        values = (np.unpackbits(descriptors, axis=1).astype(np.float32) @ _SELECTION).astype(np.uint64)
        numbered = values * np.uint64(TABLES) + np.arange(TABLES, dtype=np.uint64)
        shift = np.uint64(64 - SLOTS.bit_length() + 1)
        return cls(np.unique((numbered * _MULTIPLIER) >> shift).astype(np.int32))


class PlaceIndex:
    """Images by their words, numbered as they come."""

    def __init__(self) -> None:
        self._table = np.full((SLOTS, DEPTH), -1, np.int32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def bytes(self) -> int:
        """Memory of the table."""
        return self._table.nbytes

    def add(self, words: Words) -> int:
        """Take in an image; returns its number."""
        entries = self._table[words.slots]
        entries[:, 1:] = entries[:, :-1]
        entries[:, 0] = self._count
        self._table[words.slots] = entries
        self._count += 1
        return self._count - 1

    def shared(self, words: Words) -> np.ndarray:
        """Words that an image shares with each of those taken in, int64 (images,)."""
        entries = self._table[words.slots]
        return np.bincount(entries[entries >= 0], minlength=self._count)

    def likeliest(
        self,
        words: Words,
        count: int,
        before: int | None = None,
        apart: int = 2,
        least: float = 0.0,
        among: np.ndarray | None = None,
    ) -> list[int]:
        """Numbers of the images that share most words, the likeliest first.

        Args:
            words: Of the image that is looked for.
            count: At most.
            before: Only images with lower numbers count.
            apart: Neighbours of one that was chosen, by number, are not.
            among: Only images where it is true count, bool (before,).
            least: Multiple of the median of these that must be shared: unlike places share words, too.
        """
        shared = self.shared(words)[: self._count if before is None else max(before, 0)]
        if among is not None:
            shared = np.where(among, shared, 0)
        counted = shared if among is None else shared[among]
        enough = least * float(np.median(counted)) if len(counted) else 0.0
        found: list[int] = []
        for n in np.argsort(-shared, kind="stable").tolist():
            if len(found) == count or shared[n] <= enough:
                break
            if all(abs(n - other) > apart for other in found):
                found.append(n)
        return found


def _selection() -> np.ndarray:
    """Value of each bit of a descriptor in each table's word, float32 (256, TABLES)."""
    rng = np.random.default_rng(_SEED)
    values = np.zeros((256, TABLES), np.float32)
    for table in range(TABLES):
        values[rng.choice(256, BITS, replace=False), table] = 2.0 ** np.arange(BITS)
    return values


_SELECTION = _selection()
