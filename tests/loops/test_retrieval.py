"""Images by their words: found again though bits have changed, in memory that does not grow."""

import numpy as np

from warpslam.loops.retrieval import MOST_DESCRIPTORS, PlaceIndex, Words


def place(seed: int, count: int = 300) -> np.ndarray:
    """Descriptors of a place."""
    return np.random.default_rng(seed).integers(0, 256, (count, 32), dtype=np.uint8)


def seen_again(descriptors: np.ndarray, seed: int, bits: int = 20, share: float = 0.4) -> np.ndarray:
    """A share of them with so many bits changed, among others."""
    rng = np.random.default_rng(seed)
    kept = np.unpackbits(descriptors[: int(share * len(descriptors))], axis=1)
    for row in kept:
        row[rng.choice(256, bits, replace=False)] ^= 1
    others = rng.integers(0, 256, (len(descriptors) - len(kept), 32), dtype=np.uint8)
    return rng.permutation(np.concatenate([np.packbits(kept, axis=1), others]))


def test_a_place_is_found_again():
    """By two fifths of its corners, 20 of 256 bits of each changed, among 50 others."""
    index = PlaceIndex()
    for seed in range(50):
        index.add(Words.of(place(seed)))
    for seed in (0, 17, 49):
        words = Words.of(seen_again(place(seed), 100 + seed))
        assert index.likeliest(words, 1) == [seed]
        shared = index.shared(words)
        assert shared[seed] > 10 * np.delete(shared, seed).max()


def test_what_is_nowhere_shares_next_to_nothing():
    index = PlaceIndex()
    for seed in range(20):
        index.add(Words.of(place(seed)))
    assert index.shared(Words.of(place(99))).max() < 0.02 * len(Words.of(place(99)).slots)


def test_neighbours_and_what_came_later_are_left_out():
    index = PlaceIndex()
    for n in range(12):
        index.add(Words.of(seen_again(place(1), n, share=0.9)))
    words = Words.of(place(1))
    chosen = index.likeliest(words, 3, before=10, apart=2)
    assert len(chosen) == 3 and max(chosen) < 10
    assert min(abs(a - b) for a in chosen for b in chosen if a != b) > 2
    assert index.likeliest(words, 3, before=0) == []


def test_what_stands_out_of_nothing_is_no_place():
    """Where all images share about as many words, none is the place; one that shares twice as many is."""
    index = PlaceIndex()
    for n in range(9):
        index.add(Words.of(seen_again(place(1), n, share=0.5)))
    words = Words.of(place(1))
    assert index.likeliest(words, 3, least=1.4) == []
    index.add(Words.of(seen_again(place(1), 99, bits=5, share=0.9)))
    assert index.likeliest(words, 3, least=1.4) == [9]


def test_memory_is_bounded_and_answers_repeat():
    first, second = PlaceIndex(), PlaceIndex()
    size = first.bytes
    for seed in range(30):
        for index in (first, second):
            index.add(Words.of(place(seed, 3 * MOST_DESCRIPTORS)))
    assert first.bytes == size <= 40e6
    words = Words.of(place(3))
    np.testing.assert_array_equal(first.shared(words), second.shared(words))


def test_an_image_without_corners_is_no_place():
    index = PlaceIndex()
    index.add(Words.of(place(0)))
    empty = Words.of(np.zeros((0, 32), np.uint8))
    assert index.likeliest(empty, 3) == []
    assert index.add(empty) == 1 and len(index) == 2
