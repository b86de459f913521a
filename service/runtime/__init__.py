"""What a process of the service is made of: settings, logs, signals, and the supervisor of several."""
