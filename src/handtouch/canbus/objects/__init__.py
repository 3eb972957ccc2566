"""What a node has and says: its channels, its electronic data sheet, its PDO mapping, SDO and EMCY."""
