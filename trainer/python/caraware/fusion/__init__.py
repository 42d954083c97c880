"""The learned estimator of the preset `fusion`: dead reckoning, fixes and a map, weighed by a recurrent network.

Carrier (`carrier.py`), estimator (`estimator.py`), how it learns (`learner.py`), on a stream (`estimating.py`), the
training loop (`loop.py`); `train.py` is its trainer process.
What it sees and does, equations and figures: docs/fusion.md.
"""
