"""What stands in the picture: objects and fingertips as meshes, lines and arrows of the page.

Nothing of the wire, and no controls.
"""
