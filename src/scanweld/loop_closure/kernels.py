"""Compiled kernel of place recognition: a range of keyframes is one thread's share."""

from __future__ import annotations

from scanweld.parallel import kernel


@kernel
def count_shared_words(start, stop, words, counts, present, shared):
    """Count the words of keyframes start..stop that the query has too.

    words : (K, F, W) uint16, of the features of each keyframe
    counts : (K,) int32, features of each keyframe
    present : (W, 65536) uint8, 1 where the query has the word at that place of a descriptor
    shared : (K,) int32, written
    """
    for k in range(start, stop):
        total = 0
        for f in range(counts[k]):
            for w in range(words.shape[2]):
                total += present[w, words[k, f, w]]
        shared[k] = total
