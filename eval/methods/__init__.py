"""Methods that write folders of the protocol, one a file."""
