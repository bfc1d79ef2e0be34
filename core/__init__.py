"""Gapbridge's mathematics: arms, deflection, compensation, identification, diagnosis.

Arrays in, arrays out: no sockets, no clock, no prints. Files are touched only where logs and arm
descriptions are read, and where compiled functions look whether their sources are as they were.
"""
