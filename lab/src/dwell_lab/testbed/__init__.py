"""The testbed: hosts, links and CPUs of a cell on one machine, and their disturbances.

Network namespaces emulate hosts, TUN devices with a process between them emulate links, and
control groups with a quota emulate CPUs. The live runtime runs on them unchanged.
"""
