"""`softfinger accuracy`: what each rolling method costs and how far it strays.

The references are computed here by other means than the kernels'; nothing of them is used to render.
"""
