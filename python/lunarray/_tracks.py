"""Positions that are known at some times, as the segments of positions of a downlink.

A segment holds one polynomial of degree 7 in time for each antenna, at equal steps: the ground's interpolation through eight of
these nodes is this polynomial. Time is divided until polynomials meet the positions.
"""

import warnings

import numpy as np
from numpy.polynomial import chebyshev

from ._native import Error

#: Nodes of the ground's interpolation.
NODES = 8

#: Longest step between nodes, ticks of 1 us: the format has 32 bits for it.
STEP_MAX = 4_294_000_000

#: Shortest time without positions that ends a segment, s.
GAP_S = 60.0


#: How far below its mean radius the Moon's ground reaches, m.
MOON_RELIEF_M = 12e3


def require_above_ground(position_m, radius_m):
    """Requires that positions, a row each, are as far from the Moon's centre as its ground."""
    low_m = np.linalg.norm(position_m, axis=-1).min()
    if low_m < radius_m - MOON_RELIEF_M:
        raise Error(f"a position {low_m / 1e3:.3f} km from the Moon's centre: expected metres from there, and none below the ground")


class Track:
    """Positions of antennas (from 0) at times, s: a row for each. Of rows with the same antenna and time one counts."""

    def __init__(self, time_s, antenna, position_m, antennas):
        if not np.isfinite(position_m).all():
            raise Error("a position is not finite: expected metres for every antenna with data")
        # The format's middles of integrations.
        time_s = np.rint(time_s * 2e6) / 2e6
        order = np.lexsort((antenna, time_s))
        time_s, antenna = time_s[order], antenna[order]
        first = np.ones(len(order), bool)
        first[1:] = (np.diff(time_s) != 0) | (np.diff(antenna) != 0)
        self.time_s, self.antenna = time_s[first], antenna[first]
        self.position_m = position_m[order][first]
        self.antennas = antennas
        self.times_s = np.unique(self.time_s)
        # Where an antenna without positions is said to be: where it was last, or will be first.
        self.last_m = np.full((antennas, 3), np.nan)
        numbers, at = np.unique(self.antenna, return_index=True)
        self.last_m[numbers] = self.position_m[at]
        self.last_m[np.isnan(self.last_m)] = self.position_m[0].max()

    @classmethod
    def of_all(cls, time_s, position_m):
        """Of positions of all antennas at each time: shape (times, antennas, 3)."""
        times, antennas, _ = position_m.shape
        return cls(np.repeat(time_s, antennas), np.tile(np.arange(antennas), times), position_m.reshape(-1, 3), antennas)

    def segments(self, tolerance_m, longest_s):
        """Segments of at least eight nodes, in order of time: the first tick, ticks of a step, and positions by node.

        They cover all integrations of up to ``longest_s`` about the times."""
        spacing = np.diff(self.times_s)
        gap_s = max(GAP_S, 8 * np.median(spacing) if len(spacing) else 0.0, 8 * longest_s)
        ends = np.flatnonzero(spacing > gap_s)
        for low, high in zip([0, *(ends + 1)], [*ends, len(self.times_s) - 1]):
            yield from self._of_run(low, high, tolerance_m, 0.5 * longest_s)

    def _of_run(self, low, high, tolerance_m, margin_s):
        parts = [(low, high)]
        while parts:
            first, last = parts.pop()
            fits = self._fits(first, last)
            if last > first and max(misfit for *_, misfit in fits.values()) > tolerance_m:
                middle = (first + last) // 2
                # The parts meet at a time, so that no time between is left out, if they have more than two.
                parts += [(middle + (last - first == 1), last), (first, middle)]
                continue
            before = margin_s if first == low else 0.0
            after = margin_s if last == high else 0.0
            yield self._segment(self.times_s[first] - before, self.times_s[last] + after, fits)

    def _fits(self, first, last):
        """Of each antenna with positions between two times: middle and half of the time, coefficients, and the largest misfit, m."""
        low, high = self.times_s[first], self.times_s[last]
        rows = slice(np.searchsorted(self.time_s, low), np.searchsorted(self.time_s, high, side="right"))
        time_s, antenna, position_m = self.time_s[rows], self.antenna[rows], self.position_m[rows]
        middle_s, half_s = 0.5 * (time_s[0] + time_s[-1]), max(0.5 * (time_s[-1] - time_s[0]), 1e-6)
        found = {}
        for number in np.unique(antenna):
            mine = antenna == number
            x, y = (time_s[mine] - middle_s) / half_s, position_m[mine]
            with warnings.catch_warnings():
                # Times too close for a degree of their own.
                warnings.simplefilter("ignore", np.exceptions.RankWarning)
                terms = chebyshev.chebfit(x, y, min(NODES, len(x)) - 1)
            misfit = np.abs(chebyshev.chebval(x, terms).T - y).max()
            found[int(number)] = middle_s, half_s, terms, misfit
        return found

    def _segment(self, from_s, until_s, fits):
        start = int(np.floor(from_s * 1e6)) - 1
        ticks = int(np.ceil(until_s * 1e6)) + 1 - start
        intervals = max(NODES - 1, -(-ticks // STEP_MAX))
        step = max(1, -(-ticks // intervals))
        node_s = (start + step * np.arange(intervals + 1)) * 1e-6
        places = np.tile(self.last_m, (len(node_s), 1, 1))
        for number, (middle_s, half_s, terms, _) in fits.items():
            places[:, number] = chebyshev.chebval((node_s - middle_s) / half_s, terms).T
            self.last_m[number] = places[-1, number]
        return start, step, places.reshape(len(node_s), -1)


def interpolated(segment, t_s, antenna):
    """Positions of antennas at times by a segment, as the ground interpolates them: a row a time."""
    start, step, places = segment
    steps = (t_s * 1e6 - start) / step
    first = np.clip(np.floor(steps) - (NODES // 2 - 1), 0, len(places) - NODES).astype(int)
    factors = _lagrange(steps - first, np.tile(np.arange(float(NODES)), (len(t_s), 1)))
    nodes = places.reshape(len(places), -1, 3)
    return sum(factors[:, [k]] * nodes[first + k, antenna] for k in range(NODES))


def between(times_s, position_m, t_s):
    """Positions of all antennas at other times, by polynomials through the eight nearest samples, and how unsure they are, m, without what
    antennas have in common: how far those through the six nearest are, and the nearest sample is from its eight neighbours'."""
    count = min(NODES, len(times_s))
    found, fewer = (_through(times_s, position_m, t_s, nodes) for nodes in (count, max(count - 2, 1)))
    unsure_m = _apart_m(fewer - found)
    half = NODES // 2
    inner = np.arange(half, len(times_s) - half)
    if len(inner):
        others = inner[:, None] + np.delete(np.arange(-half, half + 1), half)
        factors = _lagrange(times_s[inner], times_s[others])
        predicted = sum(factors[:, k, None, None] * position_m[others[:, k]] for k in range(NODES))
        rough_m = np.zeros(len(times_s))
        rough_m[inner] = _apart_m(predicted - position_m[inner])
        unsure_m = np.maximum(unsure_m, rough_m[np.searchsorted(0.5 * (times_s[1:] + times_s[:-1]), t_s)])
    return found, unsure_m


def _apart_m(off_m):
    """The largest difference of an antenna from the mean of all, by time."""
    return np.linalg.norm(off_m - off_m.mean(axis=1, keepdims=True), axis=2).max(axis=1)


def _through(times_s, position_m, t_s, count):
    edges_s = 0.5 * (times_s[1:] + times_s[:-1]) if count % 2 else times_s
    first = np.clip(np.searchsorted(edges_s, t_s, side="right") - count // 2, 0, len(times_s) - count)
    factors = _lagrange(t_s, times_s[first[:, None] + np.arange(count)])
    return sum(factors[:, k, None, None] * position_m[first + k] for k in range(count))


def _lagrange(t, nodes):
    """Factors of the values at nodes, a row a time, of the polynomials through them."""
    factors = np.ones(nodes.shape)
    for k in range(nodes.shape[1]):
        for other in range(nodes.shape[1]):
            if other != k:
                factors[:, k] *= (t - nodes[:, other]) / (nodes[:, k] - nodes[:, other])
    return factors
