"""Localisation with others' help: estimators over a vehicle's own sensors and the messages that arrived.

`joint.py` has the filter over several vehicles, `implicit.py` a published baseline, `views.py` reads `neighbours`, and
`caraware.study.cooperation` compares them on recorded ticks (docs/cooperation.md).
"""
