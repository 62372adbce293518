"""What an evaluation of a registration says of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpslam.kernels.direct import equations as eq


@dataclass(frozen=True)
class Measures:
    """How well a frame fits a keyframe; all in [0, 1] but the correlation, which is in [-1, 1]."""

    view: float
    """Share of the keyframe's points that fall into the frame."""
    known: float
    """Share of them where both have depth."""
    agreement: float
    """Share of those whose depth is the one expected."""
    correlation: float
    """Of grey values, points hidden from the frame left out."""

    @classmethod
    def of(cls, counts: np.ndarray) -> Measures:
        """From the counts (16,) of an evaluation."""
        points = max(float(counts[eq.POINTS]), 1.0)
        known = float(counts[eq.AGREE] + counts[eq.IN_FRONT] + counts[eq.BEHIND])
        n = max(float(counts[eq.GREY_COUNT]), 1.0)
        grey, key, grey2, key2, both = (float(counts[k]) / n for k in range(eq.SUM_GREY, eq.SUM_BOTH + 1))
        spread = max(grey2 - grey * grey, 1e-3) * max(key2 - key * key, 1e-3)
        return cls(
            view=float(counts[eq.IN_VIEW]) / points,
            known=known / points,
            agreement=float(counts[eq.AGREE]) / max(known, 1.0),
            correlation=(both - grey * key) / spread**0.5,
        )

    @property
    def worth(self) -> float:
        """By which poses are compared."""
        return self.agreement * max(self.correlation, 0.0)
