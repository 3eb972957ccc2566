"""CAN buses: opening, receiving, sending, counters, bus state and SYNC."""
