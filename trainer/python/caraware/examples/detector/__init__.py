"""A detector of road users in camera images: it is trained on images of this simulator and fills `object_*` fields.

`python -m caraware.examples.detector --help`; docs/detector.md.
"""
