"""What a run reports: metrics, evaluations against the baselines, statistics, plots."""
