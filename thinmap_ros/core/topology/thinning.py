"""Zhang-Suen thinning, exactly as published, on rows packed into 64-bit words."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import inlined, kernel

Words = NDArray[np.uint64]
Index = np.uintp  # unsigned: compiled code then asks no question about indices below zero
_WORD = 64
_LANES = 4  # words that processors work on at once


def thin(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Skeleton of the free cells: the cells that Zhang and Suen's two sub-iterations leave.

    free (H, W) bool; returns (H, W) bool, the input is not touched. Cells outside the array count as not free. All
    deletions of a sub-iteration happen at once; the two alternate until neither deletes a cell.
    Source: topological map paper section 2.1, steps 1 and 2 (S(p1) counted cyclically, p2 p3 ... p9 p2).
    """
    words, stride = _pack(np.ascontiguousarray(free, dtype=np.bool_))
    _thin_words(words, stride)
    return _unpack(words, stride, free.shape)


def _pack(free: NDArray[np.bool_]) -> tuple[Words, int]:
    """Rows as words inside a border of empty ones, one after the other; and the words of a row.

    Bit i of word w is column 64 w + i. Some more empty words follow, so that whole lanes may be read at the end.
    """
    rows, cols = free.shape
    count = -(-cols // _WORD)
    padded = np.zeros((rows, count * _WORD), dtype=np.bool_)
    padded[:, :cols] = free
    words = np.zeros((rows + 2) * (count + 2) + _LANES, dtype=np.uint64)
    inner = words[:-_LANES].reshape(rows + 2, count + 2)[1:-1, 1:-1]
    inner[:] = np.packbits(padded, axis=1, bitorder='little').view('<u8')
    return words, count + 2


def _unpack(words: Words, stride: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    inner = words[:-_LANES].reshape(-1, stride)[1:-1, 1:-1]
    in_bytes = np.ascontiguousarray(inner).astype('<u8').view(np.uint8)
    return np.unpackbits(in_bytes, axis=1, count=shape[1], bitorder='little').view(np.bool_)


@inlined
def _find(words: Words, first: Index, count: Index, stride: Index, north: bool, deleted: Words) -> None:
    """Bits that a sub-iteration deletes in some words of a row: conditions (a) to (d) for 64 cells at once.

    north: the first sub-iteration, which keeps what (c) and (d) say of p2 p4 p6 and p4 p6 p8; else the second.
    """
    one, top, step = np.uint64(1), np.uint64(63), Index(1)
    for k in range(count):
        at = first + k
        p2, p1, p6 = words[at - stride], words[at], words[at + stride]
        p3 = (p2 >> one) | (words[at - stride + step] << top)
        p4 = (p1 >> one) | (words[at + step] << top)
        p5 = (p6 >> one) | (words[at + stride + step] << top)
        p9 = (p2 << one) | (words[at - stride - step] >> top)
        p8 = (p1 << one) | (words[at - step] >> top)
        p7 = (p6 << one) | (words[at + stride - step] >> top)
        # S = 1 by counting the rises 0 -> 1 up to two: `some` has one or more, `many` two or more.
        some, many = ~p2 & p3, np.uint64(0)
        for rise in (~p3 & p4, ~p4 & p5, ~p5 & p6, ~p6 & p7, ~p7 & p8, ~p8 & p9, ~p9 & p2):
            many |= some & rise
            some |= rise
        # Where S = 1 the neighbours are one run of ones and one of zeros. 2 <= N <= 6 says that both are longer than
        # 1, which is to say that in each there is a neighbour over an edge and one over a corner.
        pair = (p2 | p4 | p6 | p8) & (p3 | p5 | p7 | p9)
        gap = ~((p2 & p4 & p6 & p8) | (p3 & p5 & p7 & p9))
        kept = p4 & p6 & (p2 | p8) if north else p2 & p8 & (p4 | p6)
        deleted[at] = p1 & some & ~many & pair & gap & ~kept


@kernel
def _thin_words(words: Words, stride: int) -> None:
    """Delete in place, `stride` words a row, until nothing changes.

    A word is looked at only when a word in it or beside it changed in one of the last two sub-iterations: before
    that, the same sub-iteration has already seen these very cells and left them. In a row, the words from the first
    to the last such one are looked at together, so that the compiler can treat several at a time.
    """
    rows = (words.size - _LANES) // stride
    deleted = np.empty(words.size, dtype=np.uint64)
    # Of the last two sub-iterations: the rows beside changes, and the columns of the changes there (first, end).
    active, counts = np.empty((2, rows), dtype=np.int64), np.zeros(2, dtype=np.int64)
    first, end = np.full((2, rows), stride, dtype=np.int64), np.zeros((2, rows), dtype=np.int64)
    stamps = np.full(rows, -1, dtype=np.int64)
    due = np.empty((rows, 2), dtype=np.int64)
    for row in range(1, rows - 1):
        for which in range(2):
            active[which, counts[which]], counts[which] = row, counts[which] + 1
            low, high = _trimmed(words, row * stride + 1, (row + 1) * stride - 1)
            first[which, row], end[which, row] = low - row * stride, high - row * stride
    turn = 0
    while counts[0] + counts[1] > 0:
        total = 0
        for which in range(2):
            for row in active[which, : counts[which]]:
                if stamps[row] == turn:
                    continue
                stamps[row] = turn
                low = row * stride + max(min(first[0, row], first[1, row]) - 1, 1)
                high = row * stride + min(max(end[0, row], end[1, row]) + 1, stride - 1)
                due[total, 0], due[total, 1] = low, high
                total += 1
        for low, high in due[:total]:
            count = Index((high - low + _LANES - 1) // _LANES * _LANES)
            if turn % 2 == 0:
                _find(words, Index(low), count, Index(stride), True, deleted)
            else:
                _find(words, Index(low), count, Index(stride), False, deleted)
        which = turn % 2
        for row in active[which, : counts[which]]:
            first[which, row], end[which, row] = stride, 0
        counts[which] = 0
        for low, high in due[:total]:
            low, high = _trimmed(deleted, low, high)
            for at in range(low, high):
                words[at] &= ~deleted[at]
            if low < high:
                middle = low // stride
                for row in range(max(middle - 1, 1), min(middle + 2, rows - 1)):
                    if end[which, row] == 0:
                        active[which, counts[which]], counts[which] = row, counts[which] + 1
                    first[which, row] = min(first[which, row], low - middle * stride)
                    end[which, row] = max(end[which, row], high - middle * stride)
        turn += 1


@inlined
def _trimmed(words: Words, low: int, high: int) -> tuple[int, int]:
    """A range without the empty words at its ends."""
    while low < high and words[low] == 0:
        low += 1
    while low < high and words[high - 1] == 0:
        high -= 1
    return low, high
