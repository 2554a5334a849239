/* Tells from which sources a library was built: `stamp` of building.py computes the text,
 * library.py compares it. */
#include "anc.h"

#ifndef ANC_STAMP
#define ANC_STAMP "" /* not built by building.py */
#endif

extern ANC_PUBLIC const char anc_stamp[];
const char anc_stamp[] = ANC_STAMP;
