"""A sensor node on a Linux computer: four ADC channels per pad (kernel's IIO interface), CANopen by `device`.

`settings` reads its file, `iio` and `buffered` read ADCs, `scan` decodes buffers, `sampling` makes counts of
them at every SYNC, `pad_input` reports failures by EMCY, `excitation` switches the sheets, `identity_store`
keeps node ids and serial numbers, `service` runs it all, `noise` measures it.
"""
