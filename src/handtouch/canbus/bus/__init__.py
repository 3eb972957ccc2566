"""One CAN bus: open it, receive, send, count; the slab that samples go to; SYNC on all buses."""
