"""Zhang-Suen thinning, exactly as published, on rows packed into 64-bit words."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import inlined, kernel

Words = NDArray[np.uint64]
_WORD = 64


def thin(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Skeleton of the free cells: the cells that Zhang and Suen's two sub-iterations leave.

    free (H, W) bool; returns (H, W) bool, the input is not touched. Cells outside the array count as not free. All
    deletions of a sub-iteration happen at once; the two alternate until neither deletes a cell.
    Source: topological map paper section 2.1, steps 1 and 2 (S(p1) counted cyclically, p2 p3 ... p9 p2).
    """
    words = _pack(np.ascontiguousarray(free, dtype=np.bool_))
    _thin_words(words.ravel(), words.shape[1])
    return _unpack(words, free.shape[1])


def _pack(free: NDArray[np.bool_]) -> Words:
    """Rows as words, bit i of word w is column 64 w + i, inside a border of empty words."""
    rows, cols = free.shape
    count = -(-cols // _WORD)
    padded = np.zeros((rows, count * _WORD), dtype=np.bool_)
    padded[:, :cols] = free
    words = np.zeros((rows + 2, count + 2), dtype=np.uint64)
    words[1:-1, 1:-1] = np.packbits(padded, axis=1, bitorder='little').view('<u8')
    return words


def _unpack(words: Words, cols: int) -> NDArray[np.bool_]:
    inner = np.ascontiguousarray(words[1:-1, 1:-1]).astype('<u8').view(np.uint8)
    return np.unpackbits(inner, axis=1, count=cols, bitorder='little').view(np.bool_)


@inlined
def _deletable(words: Words, at: int, stride: int, first: bool) -> np.uint64:
    """Bits of one word that a sub-iteration deletes: conditions (a) to (d) for 64 cells as boolean algebra."""
    one, top = np.uint64(1), np.uint64(63)
    p2, p1, p6 = words[at - stride], words[at], words[at + stride]
    p3 = (p2 >> one) | (words[at - stride + 1] << top)
    p4 = (p1 >> one) | (words[at + 1] << top)
    p5 = (p6 >> one) | (words[at + stride + 1] << top)
    p9 = (p2 << one) | (words[at - stride - 1] >> top)
    p8 = (p1 << one) | (words[at - 1] >> top)
    p7 = (p6 << one) | (words[at + stride - 1] >> top)
    # S = 1 by counting the rises 0 -> 1 up to two: `some` has one or more, `many` two or more.
    some, many = ~p2 & p3, np.uint64(0)
    for rise in (~p3 & p4, ~p4 & p5, ~p5 & p6, ~p6 & p7, ~p7 & p8, ~p8 & p9, ~p9 & p2):
        many |= some & rise
        some |= rise
    # Where S = 1 the neighbours are one run of ones and one of zeros: 2 <= N <= 6 says that both are longer than 1.
    pair = (p2 & p3) | (p3 & p4) | (p4 & p5) | (p5 & p6) | (p6 & p7) | (p7 & p8) | (p8 & p9) | (p9 & p2)
    gap = ~((p2 | p3) & (p3 | p4) & (p4 | p5) & (p5 | p6) & (p6 | p7) & (p7 | p8) & (p8 | p9) & (p9 | p2))
    kept = p4 & p6 & (p2 | p8) if first else p2 & p8 & (p4 | p6)
    deleted: np.uint64 = p1 & some & ~many & pair & gap & ~kept
    return deleted


@kernel
def _thin_words(words: Words, stride: int) -> None:
    """Delete in place, words (N,) row after row with `stride` words a row, until nothing changes.

    A word is looked at only when a cell in it or beside it changed in one of the last two sub-iterations: before
    that, the same sub-iteration has already seen these very cells and left them.
    """
    stamps = np.full(words.size, -1, dtype=np.int32)
    due = np.empty(words.size, dtype=np.int64)
    deleted = np.empty(words.size, dtype=np.uint64)
    changed = np.empty((2, words.size), dtype=np.int64)
    bits = np.empty((2, words.size), dtype=np.uint64)
    counts = np.zeros(2, dtype=np.int64)
    turn = 0
    while turn < 2 or counts[0] + counts[1] > 0:
        total = 0
        if turn < 2:
            for at in range(stride, words.size - stride):
                due[total] = at
                total += words[at] != 0
        else:
            for which in range(2):
                total = _list_due(words, stride, stamps, changed[which, : counts[which]], bits[which], turn, due, total)
        if turn % 2 == 0:
            for i in range(total):
                deleted[i] = _deletable(words, due[i], stride, True)
        else:
            for i in range(total):
                deleted[i] = _deletable(words, due[i], stride, False)
        count = 0
        parity = turn % 2
        for i in range(total):
            words[due[i]] &= ~deleted[i]
            changed[parity, count] = due[i]
            bits[parity, count] = deleted[i]
            count += deleted[i] != 0
        counts[parity] = count
        turn += 1


@inlined
def _list_due(
    words: Words,
    stride: int,
    stamps: NDArray[np.int32],
    changed: NDArray[np.int64],
    bits: Words,
    turn: int,
    due: NDArray[np.int64],
    total: int,
) -> int:
    """Append, once each, the words that a change touches: three rows, and the next word where an end bit fell."""
    for i in range(changed.size):
        left = changed[i] - np.int64(bits[i] & np.uint64(1))
        right = changed[i] + np.int64(bits[i] >> np.uint64(63))
        for middle in range(left, right + 1):
            for at in (middle - stride, middle, middle + stride):
                fresh = (stamps[at] != turn) & (words[at] != 0)
                stamps[at] = turn
                due[total] = at
                total += fresh
    return total
