"""Data sets of collocated photographs: the format (`schema`) and the virtual camera that makes them (`capture`)."""
