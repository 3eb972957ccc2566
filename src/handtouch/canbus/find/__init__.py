"""Who is on a bus: listen, ask, and give ids to nodes without one."""
