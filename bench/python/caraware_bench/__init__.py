"""Programs that `caraware bench` starts: the Python side of its measurements."""
