"""Search for nodes on a bus: passive analysis, probes, and LSS for nodes without an id."""
