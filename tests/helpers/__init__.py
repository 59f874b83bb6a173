"""What several test files share. No tests, and no stubs for devices."""
