"""Make map.csv, observations.csv and truth.csv: a bicycle ride of nearly two laps, seen by its altitude alone.

Needs the package bokeh_sampledata (tried with 2026.1), which `zakai` itself does not:

    pip install bokeh_sampledata
    python make_record.py

PROVENANCE.md says where the ride comes from and what is done to it here.
"""

from pathlib import Path

import numpy as np
from bokeh_sampledata.cycling import cycling

HERE = Path(__file__).parent
EARTH = 6_371_009.0  # mean radius in metres
BEGIN = 500.0  # metres ridden where the map begins, after the rider has joined the loop
LAP = 19_500.0, 21_000.0  # metres ridden between which the first lap ends
KNOTS, EVERY, ERROR = 64, 30.0, 3.0  # intervals of the map; seconds between observations; metres


def track() -> tuple[np.ndarray, ...]:
    """Return time (s), east, north, distance ridden and altitude (m), and speed (m/s)."""
    ride = cycling[~cycling.time.duplicated()]
    degrees = 180 / 2**31  # the file counts half turns in units of 2^-31
    latitude, longitude = (np.radians(ride[name].to_numpy() * degrees) for name in ("position_lat", "position_long"))
    east = EARTH * np.cos(latitude[0]) * (longitude - longitude[0])
    north = EARTH * (latitude - latitude[0])
    ridden = (ride[name].to_numpy() for name in ("distance", "altitude", "speed"))
    return ride.time.dt.total_seconds().to_numpy(), east, north, *ridden


def position(east: np.ndarray, north: np.ndarray, first: int, last: int) -> tuple[np.ndarray, float]:
    """Return the distance along the first lap (rows first to last) of every row from `first` on, and the lap's length.

    A later row is projected on the part of the lap within 150 m of where the row before it was: the loop crosses itself.
    """
    ends = np.stack([east, north], axis=1)[first : last + 1]
    steps = np.diff(ends, axis=0)
    lengths = np.hypot(*steps.T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    found = list(along[:-1]) + [0.0]
    for point in np.stack([east, north], axis=1)[last + 1 :]:
        near = np.flatnonzero(np.abs(along[:-1] - found[-1]) < 150)
        part = ((point - ends[near]) * steps[near]).sum(axis=1) / np.maximum(lengths[near], 1e-9) ** 2
        part = np.clip(part, 0, 1)
        closest = np.argmin(np.hypot(*(ends[near] + part[:, None] * steps[near] - point).T))
        found.append(along[near[closest]] + part[closest] * lengths[near[closest]])
    return np.array(found), along[-1]


def main() -> None:
    time, east, north, ridden, altitude, speed = track()
    first = int(np.searchsorted(ridden, BEGIN))
    apart = np.hypot(east - east[first], north - north[first])
    last = int(np.argmin(np.where((ridden > LAP[0]) & (ridden < LAP[1]), apart, np.inf)))
    found, length = position(east, north, first, last)
    phi = 2 * np.pi * found / length - np.pi
    # The map: a linear interpolant, fitted to the altitudes of the first lap by least squares.
    knots = np.linspace(-np.pi, np.pi, KNOTS + 1)
    hats = np.maximum(0, 1 - np.abs(phi[: last - first, None] - knots) / (knots[1] - knots[0]))
    hats[:, 0] += hats[:, -1]
    heights = np.linalg.lstsq(hats[:, :-1], altitude[first:last], rcond=None)[0]
    heights = np.append(heights, heights[0])
    # The second lap: an observation every half minute, with the error of a barometer.
    rows = np.searchsorted(time, np.arange(time[last], time[-1], EVERY))
    seconds = time[rows] - time[last]
    observations = altitude[rows] + np.random.default_rng(0).normal(0, ERROR, len(rows))

    def write(name: str, header: str, *columns: np.ndarray) -> None:
        lines = [",".join(f"{value:.6g}" for value in row) for row in zip(*columns, strict=True)]
        (HERE / name).write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")

    (HERE / "map.csv").write_text("phi,altitude\n" + "".join(f"{a!r},{h:.3f}\n" for a, h in zip(knots.tolist(), heights)))
    write("observations.csv", "time,altitude", seconds, np.round(observations, 2))
    write("truth.csv", "time,phi,v", seconds, phi[rows - first], 2 * np.pi * speed[rows] / length)
    print(f"lap of {length:.0f} m; {last - first} rows of the first, {len(rows)} observations on the second")


if __name__ == "__main__":
    main()
