"""What the service speaks of: states, requests and plans, payloads, views. No URL and no SQL."""
