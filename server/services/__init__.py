"""What the daemon is made of: services, each with its start, its stop and what its failure means.

No loop and no format: a service runs what is elsewhere.
"""
