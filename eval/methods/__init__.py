"""Methods that write folders of the protocol, one file each."""
