/* $description. See $header. */
#include "$header"

#include <math.h>
#include <string.h>

#ifdef __FAST_MATH__
#error "-ffast-math removes the checks for NaN and Inf: compile this file without it"
#endif

/* Settings. */
$settings
/* The state at the time of the export. What is not listed is zero. */
static const anc_state initial = $initial;

