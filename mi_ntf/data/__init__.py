"""Data sets of collocated photographs: the format (`schema`), everything that is read (`readers`), and the virtual
camera that makes them (`capture`)."""
