"""The testbed: hosts, links and CPUs of a cell on one machine, and what disturbs them.

Network namespaces stand for hosts, TUN devices with a process between them for links, groups of
processes with a quota for CPUs. On top runs the live runtime, unchanged.
"""
