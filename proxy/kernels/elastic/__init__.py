"""Contact with an elastic surface: `step.py` is the contact step.

`spots.py` has the contact points, `response.py` the response to their loads, `surfaces.py` the displaced surfaces.
Contains no mesh and no solution of the solid (`proxy/elastic`).
"""
