"""Messages by key between the processes of a cell: over Zenoh, or in memory for tests."""
