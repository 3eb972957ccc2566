"""The commands of `handtouch` by family: what options there are, and which module does the work.

Each family is a module with `add`, which adds its commands to the command line. What does a command's work is
loaded only when it is called, so that `--help` stays quick.
"""
