"""Percepts: motion, friction and shape of what a hand touches, from its contacts.

`motion` reports what the core's slip stage detects, in the daemon. All others are estimated by a process of
their own (`child`, `worker`): `samples` buffers the latest samples of every contact, `pipeline` runs the
estimators on them (`shape`, `friction`), and `action_request` selects the action that
would resolve most uncertainty. Pure logic over arrays of all pads; time is an argument. It runs only where a
scene or a subscriber requests percepts.
"""
