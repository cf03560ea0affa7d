"""The live node under attack, over real DDS: node, watcher and attacker are processes of their own.

What the attacker does follows from its seed; what arrives when is up to DDS and the machine, so a run is repeatable in
what is sent, not to the millisecond.
"""
