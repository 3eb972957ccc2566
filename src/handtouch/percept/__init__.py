"""Percepts: slip and motion, stiffness, shape and texture of what a hand touches, from its contacts.

Pure logic over arrays of all pads; time is an argument. `samples` buffers the latest samples of every
contact, `pipeline` runs the estimators on them (`motion`, `stiffness_estimator`, `shape`, `texture`; all
listed in `registry`), and `action_request` selects the action that would resolve most uncertainty. The daemon
runs the estimators only where a scene or a subscriber requests them.
"""
