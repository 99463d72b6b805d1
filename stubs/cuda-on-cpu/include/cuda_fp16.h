// Half precision as the compiler knows it.
#pragma once
typedef _Float16 __half;
