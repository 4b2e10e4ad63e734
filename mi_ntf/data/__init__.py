"""Data sets of photographs with a flash: the format (`schema`), everything that is read (`readers`), and the virtual
camera that makes them (`capture`)."""
