"""Where the proxy comes to rest, and what holds it there.

It is the point nearest the probe that satisfies every constraint. One object is the common case and is solved on its
own, friction's deflection included: `alone`. `among` several, those that held the proxy
last are kept and asked again, what stands in the way is added, and the smallest push that satisfies them all is found
(`half_spaces`), until nothing changes.
"""
