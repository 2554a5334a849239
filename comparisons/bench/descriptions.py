"""What each algorithm of the registry is, in one sentence."""

DESCRIPTIONS = {
    "KF-ANC": "a Kalman filter that learns the control filter and knows no rated power",
    "KF-OPC": "KF-ANC with the disturbance scaled by a constraint factor, which is meant to keep the rated power",
    "KF-PB": "a Kalman filter that learns the paths, keeps the rated power, and spends it where it reduces the noise most",
    "diagonal KF": "KF-ANC that leaves out how the weights' errors depend on each other; it computes and learns less",
    "diagonal KF-OPC": "the diagonal KF with KF-OPC's constraint factor",
    "FxRLS": "recursive least squares with exponential forgetting; it knows no rated power",
    "FxLMS": "the usual gradient descent on the squared error; it knows no rated power",
    "FxNLMS": "FxLMS with a step size relative to the power of the filtered reference",
    "leaky FxLMS": "FxLMS whose weights decay all the time, by a leak that was tuned to the rated power",
    "optimal leaky FxLMS": "leaky FxLMS that computes its leak from the rated power as it runs",
    "MOV-FxLMS": "FxLMS with a penalty on the output power, computed from the rated power as it runs",
    "MOV-FxLMS fixed": "MOV-FxLMS with a fixed penalty that was tuned to the rated power",
    "MOV-FxLMS by variance": "MOV-FxLMS with a fixed penalty, from the variance of the whole disturbance",
    "MOV-MFxLMS": "MOV-FxLMS without the delay of the secondary path in its loop",
    "two-gradient FxLMS": "FxLMS that descends on the output power instead while a sample is beyond an amplitude limit",
    "re-scaling FxLMS": "FxLMS that scales its weights down when a sample is beyond an amplitude limit",
    "clipping FxLMS": "FxLMS whose control signal is clipped at an amplitude limit",
    "frequency-domain FxLMS": "FxLMS that adapts once per block, each frequency at its own rate; it knows no rated power",
    "power-limited FxLMS": "frequency-domain FxLMS with a price on the output power that follows the measured power",
}
