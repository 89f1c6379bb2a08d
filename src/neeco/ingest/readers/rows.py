"""Selection of the valid rows of a log's table, with their times, numbers, order and gaps."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from neeco.base.errors import NeecoError, counted
from neeco.capture.documents import printable
from neeco.ingest.readers import Table, column_index, numbers
from neeco.ingest.readers import names as named
from neeco.ingest.readers.names import RecognisedColumns
from neeco.ingest.readers.sections import JointColumns, PoseColumns

DAY_S = 86400.0  # period of a time-of-day clock, s
COUNTERS = (2.0**32, 2.0**16)  # periods of unsigned counters
MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "missing", "oov", "-", "--"))  # words for no sample


@dataclass(frozen=True, kw_only=True)
class RowSettings:
    """Limits on the rows of a log."""

    min_samples: int = 4  # least rows of a usable log
    max_wrong: float = 0.05  # limit on the share of wrong (not missing) rows; with more, the file is refused
    max_unreadable: float = 0.5  # limit on the share of rows whose cells are no numbers, nor state that one is missing
    states: int = 8  # number of states listed in the notes on dropped rows
    max_same_time: float = 0.5  # limit on the share of rows at the time of another; with more, the times are too coarse
    stuck_s: float = 0.5  # time in s without change of a pose, which a tracker's noise rules out,
    stuck_samples: int = 10  # and the number of samples it needs
    gap_steps: float = 4.0  # smallest step in time that is a gap, in usual steps,
    gap_s: float = 0.15  # and in s; both hold
    restart_steps: float = 10.0  # step back in usual steps, beyond which time begins anew


SETTINGS = RowSettings()


class Rows:
    """The valid rows of a table; dropped rows by reason, and repairs and observations, for the notes."""

    def __init__(self, table: Table) -> None:
        self.table = table
        self.keep = np.ones(len(table.rows), dtype=bool)
        self.reasons: dict[str, list[int]] = {}  # the file's lines
        self.repairs: list[str] = []

    def drop(self, which: np.ndarray | list[int], reason: str) -> None:
        """Drop rows (bool [R], or their numbers), and record the reason of those that were valid so far."""
        lines = self.table.lines[which][self.keep[which]]
        if len(lines):
            self.reasons.setdefault(reason, []).extend(lines.tolist())
        self.keep[which] = False

    def drop_wrong(self, wrong: np.ndarray, reason: str) -> None:
        """Drop wrong rows (bool [R]). Raises NeecoError if they are more than `RowSettings.max_wrong`."""
        lines, count = self.table.lines[wrong & self.keep], int(self.keep.sum())
        if len(lines) > max(1, SETTINGS.max_wrong * count):
            share = f"{self.table.list_rows(lines)} ({len(lines)} of {counted(count, 'row')})"
            raise NeecoError(f"{self.table.where}: {share}: {reason}")
        self.drop(wrong, reason.split(";")[0])

    def notes(self) -> tuple[str, ...]:
        """Return the notes on dropped and repaired rows, one sentence each."""
        name = self.table.title
        dropped = (
            f"{name}: {counted(len(lines), 'row')} dropped: {reason} ({self.table.list_rows(lines)})"
            for reason, lines in self.reasons.items()
        )
        return (*self.table.notes, *dropped, *(f"{name}: {repair}" for repair in self.repairs))


def keep_measured(rows: Rows, source: PoseColumns, recognised: str | None) -> None:
    """Drop the rows whose state does not mark them as measured."""
    table = rows.table
    name = source.columns.state or recognised
    good = source.columns.good
    if name is None or not len(table.rows):
        return
    states = table.rows[:, column_index(table, name)].astype(str)
    bad = ~np.isin(np.char.lower(states), [value.lower() for value in good])
    for state, _ in Counter(states[bad].tolist()).most_common(SETTINGS.states):
        rows.drop(states == state, f"{name} is {state[:20] or 'empty'!r}")
    rows.keep &= ~bad
    if not rows.keep.any():
        raise NeecoError(
            f"{table.where}: {name}: no row is {' or '.join(good)} ({table.list_rows(table.lines[:1])} has "
            f"{str(states[0])[:20]!r}); set columns.good in the recording to the values of measured rows"
        )


def read_times(rows: Rows, source: PoseColumns | JointColumns, recognised: RecognisedColumns) -> np.ndarray:
    """Return times [R] in s; rows without one are dropped."""
    table = rows.table
    names = source.columns.time or recognised.time
    rate = source.rate_hz
    if names is None and rate is not None:
        if headers := _headers(table, range(len(table.rows))):
            problem = f"line {headers[0]} repeats the header, and its rows have no times"
            raise NeecoError(f"{table.where}: {problem}; use one file per run")
        return np.arange(len(table.rows)) / rate
    if names is None:
        problem = "no column of times found; name it as columns.time (or add t_s), or set rate_hz"
        raise NeecoError(f"{table.where}: header: {problem} if its rows have a fixed rate")
    cells, meaning = read_cells(rows, names), named.recognise_time(names)
    if rate is not None and (len(names) == 2 or meaning.time_unit or named.split_unit(names[0], "time")[1]):
        problem = f"{', '.join(names)} holds times, not frame numbers"
        raise NeecoError(
            f"{table.where}: rate_hz: {problem}; remove rate_hz, or name the column of frame numbers as columns.time"
        )
    if len(names) == 2:
        return cells[:, 0] + cells[:, 1] * 1e-9
    if rate is not None:
        return cells[:, 0] / rate
    if meaning.counts_frames:
        problem = "counts frames at an unknown rate; set rate_hz in the recording"
        raise NeecoError(
            f"{table.where}: {names[0]}: {problem} (40 for NDI Aurora, 60 for NDI Polaris) or name a column of times"
        )
    return cells[:, 0] * named.scale_of(table.where, names, "time", source.units.time, meaning.time_unit, "")


def read_cells(rows: Rows, names: tuple[str, ...]) -> np.ndarray:
    """Return numbers [R, C], and drop incomplete rows. Raises NeecoError if most are unreadable, or if no row
    remains."""
    table, values = rows.table, numbers(rows.table, names)
    missing, unreadable = dict[int, str](), dict[int, str]()  # by row: message about its first such cell
    for row, slot in np.argwhere(np.isnan(values) & rows.keep[:, None]).tolist():
        cell = str(table.rows[row, column_index(table, names[slot])])
        for faults in (missing, unreadable) if not _is_readable(cell) else (missing,):
            faults.setdefault(row, f"{names[slot]} is {printable(cell, 24)}, not a number")
    rows.drop(list(missing), f"values are missing, first: {next(iter(missing.values()), '')}")
    too_many = len(unreadable) > max(3, SETTINGS.max_unreadable * (len(unreadable) + rows.keep.sum()))
    if too_many or (missing and not rows.keep.any()):
        row, first = next(iter((unreadable if too_many else missing).items()))
        problem = f"{table.where}: {table.record} {table.lines[row]}: {first}"
        if too_many:
            similar = f"as {len(unreadable)} of {counted(len(table.rows), 'row')}"
            raise NeecoError(f"{problem} ({similar}); name other columns or repair the file")
        problem = f"{problem}, and no row has values of {', '.join(names)}"
        raise NeecoError(f"{problem}; name other columns or another file in the recording")
    return values


def _is_readable(cell: str) -> bool:
    """Return whether a cell holds a number (also one that marks a missing value) or a word for a missing sample."""
    try:
        return cell.lower() in MISSING or ("_" not in cell and float(cell) is not None)
    except ValueError:
        return False


def drop_stuck(rows: Rows, times: np.ndarray, poses: np.ndarray) -> None:
    """Drop the rows of a tracker that repeats its last pose [R, 7] after losing its tool: identical poses for
    `stuck_s`, with a jump at one end. A tool that comes to rest decelerates before."""
    used = np.flatnonzero(rows.keep)
    steps = np.linalg.norm(np.diff(poses[used, :3], axis=0), axis=1)
    if not (steps > 0).any():
        return
    usual = np.median(steps[steps > 0])
    edges = np.diff(np.concatenate([[0], (np.diff(poses[used], axis=0) == 0).all(axis=1), [0]]))
    for first, last in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        # the pose of row `first` is repeated until `last`
        jump = max([*steps[max(first - 1, 0) : first], *steps[last : last + 1]], default=0.0)
        lasted = times[used[last]] - times[used[first]]
        if last - first >= SETTINGS.stuck_samples and lasted > SETTINGS.stuck_s and jump > usual:
            rows.drop(used[first + 1 : last + 1], "the previous pose is repeated (the tracker lost its tool)")


def in_order(rows: Rows, times: np.ndarray, rate_hz: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return increasing times [T] and the rows [T] that they come from. Raises NeecoError if too few remain, or if time
    restarts. rate_hz: of a column that counts frames."""
    table, usable = rows.table, np.flatnonzero(rows.keep)
    times = _continued(rows, times, usable, rate_hz)
    order = usable[np.argsort(times[usable], kind="stable")]
    late = usable[1:][times[usable][1:] < np.maximum.accumulate(times[usable])[:-1]]
    doubled = np.concatenate([[False], np.diff(times[order]) <= 0])
    if doubled.sum() > max(SETTINGS.min_samples, SETTINGS.max_same_time * len(order)):
        raise NeecoError(
            f"{table.where}: {counted(int(doubled.sum()), 'row')} of {len(order)} have duplicate times, which are too "
            "coarse, or mix several tools; name a finer column as columns.time"
        )
    rows.drop(np.sort(order[doubled]), "duplicate time")
    order = order[~doubled]
    if len(order) < SETTINGS.min_samples:
        why = "; ".join(note.partition(": ")[2] for note in rows.notes()[:2])
        raise NeecoError(
            f"{table.where}: only {counted(len(order), 'row')} of {len(table.rows)} usable{f' ({why})' if why else ''}"
            "; record again or name the right columns"
        )
    if len(late):
        listed = table.list_rows(table.lines[late])
        rows.repairs.append(f"{counted(len(late), 'row')} out of order in time; sorted ({listed})")
    return times[order], order


def restarts(times: np.ndarray) -> tuple[float, list[int]]:
    """Return the median step of times [T], and the rows after which time restarts: a much larger backward step that is
    not due to a single misplaced time."""
    steps = np.diff(times)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf
    far = np.flatnonzero(steps < -SETTINGS.restart_steps * usual).tolist()
    jumps = [back for back in far if (times[max(back - 1, 0) : back] > times[back + 1]).all()]
    return usual, [back for back in jumps if (times[back + 2 : back + 3] < times[back]).all()]


def _continued(rows: Rows, times: np.ndarray, usable: np.ndarray, rate_hz: float | None) -> np.ndarray:
    """Return times [R] unwrapped where a counter, or the time of day, wraps around. Raises NeecoError for other
    restarts of time."""
    table, usable_times = rows.table, times[usable]
    usual, places = restarts(usable_times)
    units = [1.0, 1e-3, 1e-6, 1e-9, *([] if rate_hz is None else [1 / rate_hz])]
    periods = [DAY_S, *(count * unit for unit in units for count in COUNTERS)]
    times = times.copy()
    for back in places:
        before, after = float(usable_times[back]), float(usable_times[back + 1])
        tolerance, line = SETTINGS.gap_steps * usual, table.lines[usable[back + 1]]
        wraps = [
            period
            for period in periods  # unsigned, or signed
            for first in (0.0, -period / 2)
            if abs(after - first) <= tolerance and abs(first + period - before) <= tolerance < period / 10
        ]
        if not wraps:
            headers = _headers(table, range(usable[back] + 1, usable[back + 1]))
            why = f"line {headers[0]} repeats the header" if headers else "another run, or a clock set back"
            raise NeecoError(
                f"{table.where}: {table.record} {line}: time restarts ({before:.6g} s, then {after:.6g} s): {why}; "
                "use one file per run"
            )
        times[usable[back + 1 :]] += wraps[0]
        rows.repairs.append(f"its time wraps around after {before:.6g} s ({table.record} {line}); unwrapped")
    return times


def _headers(table: Table, rows: range) -> list[int]:
    """Return the numbers of lines that repeat the header."""
    return [int(table.lines[row]) for row in rows if tuple(table.rows[row]) == table.header]


def find_gaps(rows: Rows, times: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return the gaps in time (steps longer than 4 median steps and 0.15 s), and note them."""
    steps = np.diff(times)
    longest = max(SETTINGS.gap_steps * float(np.median(steps)), SETTINGS.gap_s)
    gaps = tuple((float(times[i]), float(times[i + 1])) for i in np.flatnonzero(steps > longest))
    if gaps:
        total = sum(end - start for start, end in gaps)
        first = ", ".join(f"{start:.2f}-{end:.2f} s" for start, end in gaps[:3])
        rows.repairs.append(f"{counted(len(gaps), 'gap')}, {total:.2f} s in all ({first}); not interpolated")
    return gaps
