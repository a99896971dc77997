"""Two to four states on a grid: what `yau-yau`, `limited-direct` and `general-direct` share."""
