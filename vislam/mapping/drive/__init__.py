"""Where a cart can drive: the drive grid and the navigation grid."""
