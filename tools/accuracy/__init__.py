"""`softfinger accuracy`: cost and error of each rolling method.

Contains no kernel of rendering: the references are computed here by other means than the kernels.
"""
