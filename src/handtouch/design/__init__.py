"""Design of a pad's electrodes: the best layout for a goal, its check, drawings and tables.

`pad_task` and `layout` describe a pad and its electrodes, `goals` what is best, `optimise` finds the best
layout, `simulated_check` checks it; `sheets` and `films` compare other sheets; `fabrication`, `pictures` and
`deployed` write it down.
"""
