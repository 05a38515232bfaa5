"""Where does robot data come from when there is no robot? A Franka-like arm in MuJoCo (extra `sim`)."""
