"""Additional forces: effects of the workspace and of objects, independent of the contact force (`contact`)."""
