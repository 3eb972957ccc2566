"""What is felt: is it slipping, how hard is it, what shape and surface has it; above contacts, below tasks.

Pure logic over arrays of all pads; time is an argument. `stream` keeps the latest samples of every contact,
`percept` runs the parts on them (`motion`, and `hardness`, `shape`, `texture`), `ask` chooses what to do to
know more. The daemon runs it only where a scene or a subscriber wants it.
"""
