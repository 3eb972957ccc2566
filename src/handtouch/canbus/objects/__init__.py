"""CANopen objects of a node over the bus: PDO mapping, SDO, EMCY."""
