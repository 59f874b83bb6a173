"""Published numbers, and slow independent implementations that the engine is compared with."""
