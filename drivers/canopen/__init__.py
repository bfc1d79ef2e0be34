"""CiA 402 drives over CANopen; the library is the top-level package ``canopen``."""
