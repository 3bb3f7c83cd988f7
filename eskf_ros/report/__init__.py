"""One HTML page that shows what a replay found: the verdict first, then the map and all curves over time."""
