"""What comes into a tick from outside: poses, as far as they are believed, and parameters on their way.

No driver, and nothing that waits: memory and arithmetic of a tick alone.
"""
