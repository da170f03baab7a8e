/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
template <class T> class ModuleBase
{
};
