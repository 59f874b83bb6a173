"""Forces on the hand in addition to the contact force: effects of the workspace and of objects.

Contains no contact force and no proxy (`contact`).
"""
