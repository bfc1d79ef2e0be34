"""Between the processes of a cell: shared memory, sockets, events and side processes."""
