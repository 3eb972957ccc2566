"""Path of a sample: slab, pad model, tick, contacts, messages. No socket, no clock, no thread."""
