"""Arms and controllers on Modbus (TCP, RTU, TLS): a driver whose register map is data."""
