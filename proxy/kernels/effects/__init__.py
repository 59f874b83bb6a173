"""Forces beside those of the contact: of the workspace, and of an object on what comes near it.

What keeps the proxy outside is `contact`.
"""
