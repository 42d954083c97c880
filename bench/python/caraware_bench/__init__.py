"""Programs that `caraware bench` starts: the Python side of what it measures."""
