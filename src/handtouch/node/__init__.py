"""A sensor node on a Linux computer: 3 to 32 channels per pad, CANopen by `device`.

`settings` reads its file. `iio` and `buffered` read ADCs (kernel's IIO interface), `scan` decodes buffers;
`source` is the base of other sources: `lines` of numbers, CAN frames by `dbc`, and what `source_kinds` finds
in other packages. `sampling` makes counts of them at every SYNC, `pad_input` reports failures by EMCY,
`excitation` switches the sheets, `identity_store` keeps node ids and serial numbers, `service` runs it all,
`noise` measures it.
"""
