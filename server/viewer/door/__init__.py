"""How the page is come by: its process, its secret address, and who may open it.

Of it only `access` needs viser's packages.
"""
