"""Seeds of random rays, without hidden state."""

from __future__ import annotations

import numpy as np


def ray_seed(*key: int) -> int:
    """Seed of one batch of rays from (seed, purpose, frame, iteration): no hidden state, so runs repeat and resume
    exactly.
    """
    return int(np.random.SeedSequence([k & 0xFFFFFFFF for k in key]).generate_state(1)[0] & 0x7FFFFFFF)
