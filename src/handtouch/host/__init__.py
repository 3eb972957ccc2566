"""Host interface of every process: signals, logging, real-time scheduling, systemd notification."""
