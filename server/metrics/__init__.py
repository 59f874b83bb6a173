"""Metrics for Prometheus, computed from the servo's records, and a Grafana dashboard.

Contains no servo and nothing that is counted elsewhere.
"""
