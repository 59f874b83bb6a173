"""Code that several test files share: no tests, and no emulators of devices."""
