"""Data sets of photographs with a flash: format (`schema`), readers (`readers`), virtual camera (`capture`)."""
