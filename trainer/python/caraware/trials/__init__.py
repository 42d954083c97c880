"""`caraware study`: many runs that search for the best values of keys (docs/trials.md)."""
