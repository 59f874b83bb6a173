"""What several test files share. No tests, and no stand-ins for devices."""
