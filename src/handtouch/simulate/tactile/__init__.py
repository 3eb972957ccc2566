"""Touch sensors inside a MuJoCo simulation: counts of the pads in a world, and the core's estimates of them.

`handtouch.simulate.tactile.sensor`, with `TactileSensor`, is the only module of the simulator that uses the
estimators; nothing in the simulator uses it.
"""
