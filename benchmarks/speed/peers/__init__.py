"""The same work done by others: plain numpy, Pinocchio, C++, CasADi."""
