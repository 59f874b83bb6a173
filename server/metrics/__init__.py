"""Figures for Prometheus, counted from the servo's records, and a Grafana dashboard of them.

No servo, and nothing that is counted anywhere else.
"""
