"""The panel: a page on loopback that starts, steers and compares runs by `caraware` commands, which it shows."""
