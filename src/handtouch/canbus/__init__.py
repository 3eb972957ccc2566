"""CANopen master: CAN buses, SYNC, and the boot-up and supervision of a hand's nodes."""

import logging

# Both libraries log every timeout and every failed attempt to open a bus; handtouch counts these and reports
# them as reasons. An application can still enable the libraries' logging.
logging.getLogger("can").addHandler(logging.NullHandler())
logging.getLogger("canopen").addHandler(logging.NullHandler())
