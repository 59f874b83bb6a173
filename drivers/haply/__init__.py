"""Haply's Inverse3, Inverse3x and Minverse through the maker's Inverse Service, which speaks JSON over a WebSocket.

`messages` is what goes over the wire, `link` the connection, `opening` finds a device and sets its filters. `pump` is
the thread that exchanges with the service, `exchange` the servo's side of the block between them, and `device` the
device behind the contract.
"""
